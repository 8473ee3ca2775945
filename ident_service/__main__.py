"""`python -m ident_service` is `ident`."""

import sys

from ident_service.cli import main

sys.exit(main())
