"""The console script `corrmat`, and `python -m corrmat`."""

import sys


def start() -> None:
    """Run the command line; Ctrl-C while it is imported leaves no traceback either."""
    try:
        from corrmat.cli import main
    except KeyboardInterrupt:
        sys.exit("corrmat: interrupted")
    sys.exit(main())


if __name__ == "__main__":
    start()
