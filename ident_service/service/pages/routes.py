"""List the routers of all pages; none is in the API's description."""

from __future__ import annotations

from typing import Final

from ident_service.service.pages import again_pages, arm_pages, entering, job_pages, maintenance_pages, run_pages

PAGES: Final = (
    entering.router,
    arm_pages.router,
    again_pages.router,
    maintenance_pages.router,
    job_pages.router,
    run_pages.router,
)
