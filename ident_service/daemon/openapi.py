"""Complete the OpenAPI description: summaries, an example of each request and of each failure."""

from __future__ import annotations

import json
import threading
from typing import Any, Final

from fastapi import FastAPI, Response

from ident_service.daemon.responses import FAILURE_SCHEMA, Failure

_CONFIRM: Final = {"name": "wam7_sim", "challenge": "bGV0IGl0IG1vdmU"}
_YAML: Final = "extends: planar2\nname: bench\ncontrol: {rate: 500}\n"
_RUN: Final = "20261101T080000Z-wam7_sim-3fa9c1"
_URDF: Final = "PHJvYm90IG5hbWU9ImJlbmNoIi8+"  # `<robot name="bench"/>` in base 64

EXAMPLES: Final[dict[str, dict[str, Any]]] = {
    "Acceptance": {"A person's decision": {"run": _RUN, "note": "after the new belt, torque error 2.1 %"}},
    "Description": {"An arm that extends a shipped one": {"description": _YAML}},
    "Enabled": {"Disable it": {"enabled": False}},
    "Event": {"Gear oil": {"what": "gear oil changed", "note": "joint 2, 40 ml"}},
    "JobRequest": {
        "Commission a simulated arm": {"job": {"kind": "simulate", "arm": "planar2", "seed": 1}},
        "Search for a motion": {"job": {"kind": "design", "arm": "wam7_sim", "seconds": 30.0}},
        "Preflight, which may move the arm": {"job": {"kind": "check", "arm": "wam7_sim"}, "confirm": _CONFIRM},
        "Run, at half the speed": {"job": {"kind": "run", "arm": "wam7_sim", "speed": 0.5}, "confirm": _CONFIRM},
        "Identify from a run": {"job": {"kind": "identify", "arm": "wam7_sim", "recordings": [{"run": _RUN}]}},
        "Export": {"job": {"kind": "export", "run": _RUN, "formats": ["urdf", "mjcf"]}},
    },
    "Labels": {"Found again": {"tags": ["cold", "new belt"], "note": "first run of the day"}},
    "Login": {"A token": {"token": "ident_x3J0"}},
    "MotionUpload": {
        "The content of a motion.json": {"arm": "planar2", "motion": '{"format": "ident-motion", "...": 0}'}
    },
    "NewArm": {
        "An arm that extends a shipped one": {"description": _YAML},
        "A later description of the same arm": {"description": _YAML, "replace": True},
        "An arm with its URDF": {
            "description": "format: ident-arm\nversion: 1\nname: mine\nkinematics: {urdf: mine.urdf}\n",
            "files": {"mine.urdf": '<robot name="mine">...</robot>'},
        },
    },
    "NewDescription": {
        "A URDF without meshes": {"name": "bench", "urdf": "bench.urdf", "files": {"bench.urdf": _URDF}}
    },
    "NewReidentification": {"Now, by a person": {"arm": "wam7_sim", "confirm": _CONFIRM}},
    "NewSchedule": {
        "Mondays at six, UTC": {"arm": "wam7_sim", "cron": "0 6 * * 1"},
        "After 500 operating hours": {"arm": "wam7_sim", "hours": 500.0},
        "After each maintenance": {"arm": "wam7_sim", "maintenance": True},
    },
    "NewUpload": {
        "A CSV of 90 MB": {"arm": "wam7_sim", "name": "monday.csv", "bytes": 94371840, "sha256": 64 * "3"},
        "With its columns": {
            "arm": "planar2",
            "name": "bench.csv",
            "bytes": 73400,
            "sha256": 64 * "a",
            "columns": "columns: {t: {column: stamp, unit: ms}, q1: pos_1, q2: pos_2, tau1: tq_1, tau2: tq_2}\n",
        },
    },
    "Pruning": {"What would go": {"keep": 20}, "Delete it": {"keep": 20, "yes": True}},
    "Remark": {"Why": {"note": "seal ordered"}},
    "Support": {"By a person who sees it": {"confirm": "wam7_sim"}},
    "Rollback": {"The set before": {"note": "the new one oscillates"}, "The second": {"note": "the best", "to": 2}},
}
"""Examples (title and value) by the name of a request's model."""

FAILURES: Final[dict[int, tuple[str, str]]] = {
    400: ("UsageError", "a description comes with 16 files at most"),
    401: ("Unauthorized", "give a valid token: Authorization: Bearer TOKEN"),
    403: ("Forbidden", "the token 'screen' may only read; this needs the role operator"),
    404: ("UnknownId", "no run 'x' is known; see the list of runs"),
    409: ("MotionRefused", "wam7_sim: a motion needs a fresh challenge of this arm"),
    413: ("TooLarge", "a request has 65536 bytes at most"),
    421: ("WrongHost", "wrong host name; use the address or name that the service was started with"),
    422: ("ConfigError", "arm.yaml:3:11: control.rate: must be greater than 0 [Hz], not -1"),
    429: ("TooManyRequests", "ten failed logins in a minute; try again in 42 s"),
    503: ("RegistryBusy", "another process has locked the registry; try again"),
    507: ("DiskFull", "the disk of the state folder is full; free space, then try again"),
}
"""Example of a failure (kind and message) by HTTP status."""


def describe(app: FastAPI) -> None:
    """Add summaries and examples to an application's OpenAPI description, and serve it."""
    plain, making = app.openapi, threading.Lock()
    made: list[bytes] = []

    def described() -> dict[str, Any]:
        if app.openapi_schema is None:
            _complete(plain())
        return plain()  # FastAPI keeps it from the first time

    def text() -> Response:
        with making:  # a second of computing, in a thread
            if not made:
                made.append(json.dumps(described()).encode())
        return Response(made[0], media_type="application/json")

    app.openapi = described  # type: ignore[method-assign]
    app.add_api_route("/api/v1/openapi.json", text, include_in_schema=False)


def _complete(document: dict[str, Any]) -> None:
    failure = Failure.model_json_schema(ref_template="#/components/schemas/{model}")
    schemas = document["components"]["schemas"] | failure.pop("$defs") | {"Failure": failure}
    document["components"]["schemas"] = dict(sorted(schemas.items()))
    for item in document["paths"].values():
        for operation in item.values():
            # The first sentence of the function's docstring says what is done; its name is only an id.
            first, _, _ = operation.get("description", "").partition("\n\n")
            sentence, _, _ = first.replace("\n", " ").partition("; ")
            operation["summary"] = sentence.removesuffix(".")
            body = operation.get("requestBody", {}).get("content", {}).get("application/json")
            if body is not None:
                name = body["schema"]["$ref"].rpartition("/")[2]
                given = EXAMPLES[name]
                body["examples"] = {title: {"value": value} for title, value in given.items()}
            for status, answer in operation["responses"].items():
                content = answer.get("content", {}).get("application/json", {})
                if content.get("schema") == {"$ref": FAILURE_SCHEMA}:
                    kind, message = FAILURES[int(status)]
                    content["example"] = {"error": {"kind": kind, "message": message}}
