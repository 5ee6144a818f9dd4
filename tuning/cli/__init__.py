"""The `ptsmc` command."""

import sys


def command() -> None:
    """Entry point: a Ctrl-C ends it in one sentence while it imports what it needs, too."""
    try:
        from tuning.cli.main import main
    except KeyboardInterrupt:
        print("ptsmc: interrupted; nothing was written", file=sys.stderr)
        sys.exit(130)
    main()
