"""The `ptsmc` command."""

import atexit
import gc
import os
import sys


def command() -> None:
    """Entry point: a Ctrl-C ends it in one sentence while it imports what it needs, too."""
    # imports and tracing make objects by the million, and hardly any in cycles: looking for these, and once more
    # through all of them at the end, took a fifth of a second
    gc.set_threshold(1_000_000)
    atexit.register(gc.freeze)
    os.environ["MPLBACKEND"] = "agg"  # figures are files: of a name that it does not know Matplotlib makes a traceback
    try:
        from tuning.cli.main import main
    except KeyboardInterrupt:
        print("ptsmc: interrupted; nothing was written", file=sys.stderr)
        sys.exit(130)
    main()
