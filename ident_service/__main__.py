"""`python -m ident_service` is `ident`."""

import sys

from ident_service.cli import main

# The processes of a search import this file again under another name.
if __name__ == "__main__":
    code = main()
    # CPython ends `python -m` by SIGINT if an interrupt has once passed through the `exec` of a string, as imports have
    # it, and was caught; another such `exec` makes it forget that.
    exec("")  # noqa: S102
    sys.exit(code)
