"""The `ptsmc` command."""

import atexit
import gc
import os
import signal
import sys
from types import FrameType

INTERRUPTED = 130  # exit status


def command() -> None:
    """Run the command line of this process: the first Ctrl-C ends it in one sentence, a second one kills it."""
    # Imports and tracing create millions of objects but hardly any reference cycles. Searching for them takes 0.2 s.
    gc.set_threshold(1_000_000)
    atexit.register(gc.freeze)
    os.environ["MPLBACKEND"] = "agg"  # figures are files
    # the compiler prints no messages ("Very slow compile?") except for fatal errors; jaxlib reads this when imported
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    signal.signal(signal.SIGINT, _interrupt)
    try:
        from tuning.cli.main import main

        main()
    except KeyboardInterrupt:  # while it imports modules or ends
        print("ptsmc: interrupted", file=sys.stderr)
        sys.exit(INTERRUPTED)


def _interrupt(signum: int, frame: FrameType | None) -> None:
    """Signal handler: raise KeyboardInterrupt. A second signal ends the process at once."""
    signal.signal(signum, signal.SIG_DFL)
    raise KeyboardInterrupt
