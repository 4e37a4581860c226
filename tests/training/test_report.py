"""The table at the end of a run."""

from vg2gt.training.report import comparison_table


def test_table_shows_values_and_changes() -> None:
    untrained = {"psnr": 20.0, "abs_rel": 0.05, "gaussians": 1000.0}
    trained = {"psnr": 23.5, "abs_rel": 0.02, "gaussians": 900.0}
    table = comparison_table(untrained, trained)
    cells = [[cell.strip() for cell in line.split("|")[1:-1]] for line in table.splitlines()]
    assert ["PSNR [dB]", "20.00", "23.50", "+3.50 (+18%)"] in cells
    assert ["rendered depth abs_rel", "0.0500", "0.0200", "-0.0300 (-60%)"] in cells
