"""The ``tagcell`` command, also as ``python -m twin``: Ctrl-C ends it in one line even while packages are imported."""

from __future__ import annotations

import os
import signal
import sys
from typing import Any


def main() -> None:
    """Run the command; exit codes as ``twin.cli.main`` says."""
    usual = signal.signal(signal.SIGINT, _stop_at_once)
    from twin.cli import main as run

    signal.signal(signal.SIGINT, usual)
    try:
        run()
    except KeyboardInterrupt:
        print("\ntagcell: stopped", file=sys.stderr)
        sys.exit(130)


def _stop_at_once(*_: Any) -> None:
    """Packages that are being imported may swallow an exception; nothing has been begun that would be left behind."""
    os.write(2, b"\ntagcell: stopped\n")
    os._exit(130)


if __name__ == "__main__":
    main()
