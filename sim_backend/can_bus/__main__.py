"""Run a wire alone until interrupted: `python -m sim_backend.can_bus NAME [--bitrate N] [--fd [--data-bitrate N]]`."""

from __future__ import annotations

import argparse
import signal
import sys
import time

from ident_service.errors import DriverError
from sim_backend.can_bus.hub import CanBusServer


def main(arguments: list[str] | None = None) -> int:
    """Host a simulated CAN bus until interrupted; return 0 when it was ended, 1 when it could not begin."""
    parser = argparse.ArgumentParser(prog="python -m sim_backend.can_bus", description=__doc__)
    parser.add_argument("name", help="what ends connect to: a name, or the path of a socket file")
    parser.add_argument("--bitrate", type=int, default=0, help="pace to keep [bit/s]; 0: none")
    parser.add_argument("--data-bitrate", type=int, help="pace of CAN FD's data [bit/s]; with --bitrate and --fd")
    parser.add_argument("--fd", action="store_true", help="carry CAN FD frames")
    options = parser.parse_args(arguments)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        with CanBusServer(options.name, options.bitrate, options.data_bitrate, fd=options.fd) as wire:
            print("ready", flush=True)
            while True:
                wire.poll(time.monotonic_ns() + 1_000_000_000)
    except KeyboardInterrupt:
        return 0
    except DriverError as error:
        print(error, file=sys.stderr)
        return 1


if __name__ == "__main__":
    sys.exit(main())
