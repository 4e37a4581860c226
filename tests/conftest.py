"""Fixtures used by every test folder."""

from pathlib import Path

import pytest

SHARED = Path(__file__).resolve().parents[2] / "shared"


@pytest.fixture(scope="session")
def shared() -> Path:
    """Folder of real samples and reference outputs that stands beside a developer's checkout; skips without it."""
    if not SHARED.is_dir():
        pytest.skip(f"needs the reference data folder {SHARED.name}/ beside the checkout")
    return SHARED
