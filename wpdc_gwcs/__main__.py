"""`wpdc` and ``python -m wpdc_gwcs``: so little that Ctrl-C finds it ready at once."""

import signal

__all__ = ["main"]


def main():
    """Run the command line."""
    # Until its own handler is there, an interrupted program ends without a word.
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from wpdc_gwcs.cli import main

    main()


if __name__ == "__main__":
    main()
