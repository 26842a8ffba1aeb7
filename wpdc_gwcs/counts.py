"""Counts in words, for messages: one star, but two stars."""

__all__ = ["counted"]


def counted(n, noun):
    """Join a number and what it counts.

    Parameters
    ----------
    n : int
        The number.
    noun : str
        Singular of what is counted; its plural must end in s.

    Returns
    -------
    str
        Number and noun, the noun in the plural unless the number is one.

    Examples
    --------
    >>> from wpdc_gwcs.counts import counted
    >>> counted(1, "star"), counted(0, "reference star")
    ('1 star', '0 reference stars')
    """
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"
