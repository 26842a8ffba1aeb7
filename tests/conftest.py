import os
from pathlib import Path

import numpy as np
import pytest

os.environ.setdefault("MPLBACKEND", "agg")

REPOSITORY = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="session")
def shared_data():
    """Folder of real frames and headers; tests that need it are skipped where it is absent."""
    folder = Path(os.environ.get("WPDC_GWCS_DATA") or REPOSITORY.parent / "shared" / "data")
    if not folder.is_dir():
        pytest.skip(f"test data not found: {folder}")
    return folder


@pytest.fixture
def rng():
    """A random generator that is the same in every run."""
    return np.random.default_rng(20160101)
