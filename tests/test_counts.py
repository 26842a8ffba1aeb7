import pytest

from wpdc_gwcs.counts import counted


@pytest.mark.parametrize(
    ("n", "text"), [(0, "0 stars"), (1, "1 star"), (2, "2 stars"), (1200, "1200 stars")]
)
def test_one_alone_is_singular(n, text):
    assert counted(n, "star") == text
