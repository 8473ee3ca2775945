"""`python -m ident_service` is `ident`."""

import sys

from ident_service.cli import main

# The processes of a search import this file again under another name.
if __name__ == "__main__":
    sys.exit(main())
