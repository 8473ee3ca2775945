"""List the routers of all pages; none is in the API's description."""

from __future__ import annotations

from typing import Final

from ident_service.daemon.web import (
    arm_pages,
    job_pages,
    maintenance_pages,
    reidentification_pages,
    run_pages,
    session_pages,
)

PAGES: Final = (
    session_pages.router,
    arm_pages.router,
    reidentification_pages.router,
    maintenance_pages.router,
    job_pages.router,
    run_pages.router,
)
