"""The process of the command `ringfence`, and of `python -m ringfence`."""

from __future__ import annotations

from ringfence.utils import interrupts


def main() -> None:
    """Run the command line; Ctrl-C ends it in a word, from the first moment on and to the last."""
    interrupts.leave_when_asked()
    from ringfence.cli.app import main as run  # which imports for most of a second

    try:
        run()
    except SystemExit as stop:
        if stop.code == interrupts.STATUS:
            interrupts.leave()
        raise


if __name__ == "__main__":
    main()
