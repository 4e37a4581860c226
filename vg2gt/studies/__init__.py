"""Several trainings that belong together: ablations, comparisons."""
