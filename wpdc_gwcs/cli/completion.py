"""Values of options, for their help and for the completion by the shell."""

__all__ = ["complete", "one_of"]


def one_of(*values):
    """Describe an option that has one of some values.

    Parameters
    ----------
    *values : str
        The values.

    Returns
    -------
    dict
        ``metavar`` and ``autocompletion`` of `typer.Option`.
    """
    return {"metavar": f"{{{','.join(values)}}}", "autocompletion": complete(*values)}


def complete(*values):
    """Build the completion of an option.

    Parameters
    ----------
    *values : str
        The values that are offered.

    Returns
    -------
    callable
        From what was typed to the values that begin with it.
    """
    return lambda incomplete: [value for value in values if value.startswith(incomplete)]
