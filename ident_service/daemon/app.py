"""Put the parts of the service together as one application; nothing is done before it starts."""

from __future__ import annotations

import asyncio
import logging
import sqlite3
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from fastapi import FastAPI
from fastapi.concurrency import run_in_threadpool

from ident_service import __version__
from ident_service.daemon.authentication import Authenticator
from ident_service.daemon.connections import Connections
from ident_service.daemon.dependencies import Service
from ident_service.daemon.errors import install_error_handlers
from ident_service.daemon.jobs.queue import Engine
from ident_service.daemon.live import LiveRuns
from ident_service.daemon.maintenance.scheduler import MaintenanceScheduler
from ident_service.daemon.maintenance.webhook import Webhook, read_secret
from ident_service.daemon.metrics import Metrics
from ident_service.daemon.news import EventPoller
from ident_service.daemon.openapi import describe
from ident_service.daemon.request_guard import RequestGuardMiddleware
from ident_service.daemon.routes import (
    about,
    arms,
    events,
    jobs,
    maintenance,
    runs,
    uploads,
    views,
)
from ident_service.daemon.routes.checks import Checks
from ident_service.daemon.run_series import RecentDocuments
from ident_service.daemon.settings import Settings
from ident_service.daemon.uploads import delete_stale_uploads
from ident_service.daemon.web import (
    arm_pages,
    job_pages,
    maintenance_pages,
    reidentification_pages,
    run_pages,
    session_pages,
)
from ident_service.daemon.web.forms import failure
from ident_service.operations.acceptance import synchronise
from ident_service.operations.deletion import remove_deleted
from ident_service.registry.arms import register_shipped_arms
from ident_service.registry.database import Database, write_deferred_entries
from ident_service.registry.runs import rebuild_runs
from ident_service.registry.tokens import first_token

_REFRESH = 1.0  # s between reads of tokens that were made or revoked at a terminal
_CLEAN = 600.0  # s between searches for abandoned uploads
_LOG = logging.getLogger("ident.serve")
PAGES = (
    session_pages.router,
    arm_pages.router,
    reidentification_pages.router,
    maintenance_pages.router,
    job_pages.router,
    run_pages.router,
)
"""Routers of the pages, which are not in the API's description."""
ROUTERS = (
    *(about.router, arms.router, jobs.router, runs.router, views.router),
    *(uploads.router, events.router, maintenance.router, *PAGES),
)
"""Routers of the application, in the order in which they are included."""


def create_app(settings: Settings, http_connections: Connections | None = None) -> FastAPI:
    """Create the service as an ASGI application: open its database, with a first token, now; run jobs in its lifespan.

    Args:
        settings: settings of the service.
        http_connections: connections of the listener that serves the application; None if others count them.

    Raises:
        UsageError: the state folder cannot be used.
    """
    db = Database(settings.state)
    first_token(db, settings.state)
    register_shipped_arms(db)
    metrics = Metrics()
    engine = Engine(
        *(db, settings.state),
        computing=settings.computing,
        motion_socket=settings.motion_socket,
        lease_factor=settings.lease_factor,
        metrics=metrics,
    )
    scheduler = MaintenanceScheduler(engine, _webhook(settings, db))
    service = Service(settings, db, engine, Authenticator(db), metrics, scheduler, Checks())

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        synchronise(db, settings.state)
        remove_deleted(settings.state)
        engine.start(lambda: rebuild_runs(db, settings.state))
        scheduler.start()
        refreshing = asyncio.create_task(_refresh(service))
        try:
            yield
        finally:
            refreshing.cancel()
            await run_in_threadpool(engine.close)
            app.state.live.close()
            await run_in_threadpool(scheduler.close)
            db.close()

    app = FastAPI(
        title="ident",
        version=__version__,
        description="Commission a robot arm. Everything is named by id; every motion needs an operator, a lease and "
        "the typed name of its arm; stop needs none of them.",
        openapi_url=None,  # FastAPI makes it anew for each request, in the event loop (`openapi.py`)
        docs_url=None,  # these pages load scripts from other machines
        redoc_url=None,
        lifespan=lifespan,
    )
    app.state.service = service
    app.state.live = LiveRuns()
    app.state.views = RecentDocuments()
    app.state.series = RecentDocuments()
    app.state.watch = EventPoller(
        db, settings.state, lambda row: jobs.job_answer_document(service, row).model_dump(mode="json")
    )
    for router in ROUTERS:
        # `include_router` would make all models of the routes again, at the first request and in the event loop.
        app.router.routes.extend(router.routes)
    describe(app)
    install_error_handlers(app, failure)
    book = Connections() if http_connections is None else http_connections
    app.add_middleware(
        RequestGuardMiddleware,
        settings=settings,
        metrics=service.metrics,
        connections=book,
        authenticator=service.authenticator,
    )
    return app


async def _refresh(service: Service) -> None:
    clean = 0.0
    while True:
        await asyncio.sleep(_REFRESH)
        try:
            if time.monotonic() >= clean:
                clean = time.monotonic() + _CLEAN
                for upload in await run_in_threadpool(delete_stale_uploads, service.state):
                    _LOG.info("an upload was left alone for a day and is deleted", extra={"upload": upload})
            await run_in_threadpool(write_deferred_entries, service.db, service.state)
            await run_in_threadpool(service.authenticator.refresh)
            await run_in_threadpool(service.db.checkpoint_when_idle)
        except (sqlite3.Error, OSError) as error:
            _LOG.error("the state folder cannot be looked after: %s", error)


def _webhook(settings: Settings, db: Database) -> Webhook | None:
    if settings.webhook is None or settings.webhook_secret is None:
        return None
    return Webhook(db, settings.webhook, read_secret(settings.webhook_secret))
