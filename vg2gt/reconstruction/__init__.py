"""From images to a scene, and from a scene to files."""
