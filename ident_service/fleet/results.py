"""Present what was found of a fleet: a document for programs, a Parquet table, one page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.resources import files
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from ident_service import __version__
from ident_service.estimation.change_detection import ALPHA
from ident_service.estimation.uncertainty import verdicts
from ident_service.fleet.arm_page import HEIGHT, WIDTH, ArmShown, environment, multiples
from ident_service.fleet.arm_page import PAGE as PAGE
from ident_service.fleet.factor import Described
from ident_service.fleet.population import Group, HeldOut, Population, Shares, Unlike
from ident_service.fleet.reduction import FleetRequest, Recorded, Reduced
from ident_service.fleet.trends import Change, Compared, parameter_series
from ident_service.model.chain import Array
from ident_service.operations.drift_alarms import FLEET as FLEET

TABLE, PROBLEMS = "parameters.parquet", "problems.json"
FORMAT: Final = "ident-fleet"
_ARMS_DRAWN = 12  # arms whose trends the page shows
_GROUPS_DRAWN = 6  # of each
_POINTS = 200  # of a small drawing
_WRITTEN = 64  # recordings that are written into the table at once
_ALL_LISTED = 500  # recordings, beyond which a page lists those with something to tell
_OF_TABLE = ("values", "standard_deviations", "verdicts", "negligible")  # of a summary, which the table has


@dataclass(frozen=True)
class FleetResult:
    """Result of the identification of a fleet.

    Attributes:
        folder: folder of the results.
        reduced: recordings, and why some were left out.
        found: the common model.
        shares: where each parameter's variance comes from.
        several: errors on held-out recordings of arms with several recordings, as these are.
        single: errors on held-out recordings with one recording of each arm alone.
        compared: the tests of each arm against the others, and over time.
        document: the content of `fleet.json`.
    """

    folder: Path
    reduced: Reduced
    found: Population
    shares: Shares
    several: HeldOut
    single: HeldOut
    compared: Compared
    document: dict[str, Any]

    @property
    def changed(self) -> list[Change]:
        """Return the changes with p below 0.01 that make at least 1 % of a joint's torque and 25 % of its residual."""
        return self.compared.changed


Summaries = Mapping[str, Mapping[str, Any]]


def group_name(group: Group, described: Described) -> str:
    """Return a group's name for a person: `friction of joint elbow`, `inertia of link 2`."""
    kind, number = group
    if kind in ("friction", "drive inertia"):
        return f"{kind} of joint {described.model.chain.names[number - 1]}"
    return f"{kind} of link {number}"


def _when(seconds: float) -> str:
    return datetime.fromtimestamp(seconds, UTC).isoformat(timespec="seconds")


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def fleet_document(
    result: FleetResult,
    summaries: Summaries,
    sha256: str,
) -> dict[str, Any]:
    """Build the content of `fleet.json`, without the alarms.

    Args:
        result: result of the identification.
        summaries: summary of each arm's estimate.
        sha256: hash of the description as it was read.
    """
    reduced, found, described = result.reduced, result.found, result.reduced.described
    base = described.base
    unlike_of: dict[str, list[Unlike]] = {arm: [] for arm in summaries}
    for one in result.compared.odd:
        unlike_of[one.arm].append(one)
    arms = {}
    for arm, recordings in reduced.arms.items():
        ranked = sorted(unlike_of[arm], key=lambda one: (one.p, -one.test.statistic))
        differs = [one for one in ranked if one.different]
        most = max(ranked, key=lambda one: one.share, default=None)
        arms[arm] = {
            "recordings": len(recordings),
            "first": _when(recordings[0].at),
            "last": _when(recordings[-1].at),
            **{key: value for key, value in summaries[arm].items() if key not in _OF_TABLE},
            "unlike_p": ranked[0].p if ranked else None,
            "unlike_torque_share": None if most is None else most.share,
            "differs": [
                {
                    "what": group_name(one.group, described),
                    "sigma": one.test.sigma,
                    "p": one.p,
                    "joint": described.model.chain.names[one.joint],
                    "torque_share": one.share,
                }
                for one in differs
            ],
        }
    ranking = sorted(
        arms, key=lambda arm: (arms[arm]["unlike_p"] or 1.0, -(arms[arm]["unlike_torque_share"] or 0.0), arm)
    )
    percent = result.shares.percent
    groups = {place: group for group, places in described.groups.items() for place in places}
    return {
        "format": FORMAT,
        "version": 1,
        "arm": {"name": described.config.name, "sha256": sha256},
        "settled": {
            "by": reduced.pilot,
            "identification": described.config.identification.model_dump(mode="json"),
        },
        "recordings": sum(len(one) for one in reduced.arms.values()),
        "left_out": [
            {"url": one.url, "piece": one.label, "kind": one.kind, "message": one.message} for one in reduced.problems
        ],
        "ranking": ranking,
        "arms": arms,
        "parameters": [
            {
                "expression": base.expressions[k],
                "unit": base.units[k],
                "group": group_name(groups[k], described),
                "common": float(found.common[k]),
                "deviation_between_arms": float(found.between[k]),
                "variance_percent": {"arms": percent[k, 0], "recordings": percent[k, 1], "noise": percent[k, 2]},
            }
            for k in range(base.size)
        ],
        "groups": [
            {
                "name": group_name(group, described),
                "deviation_between_arms_torque": value,
                "recordings_factor": result.compared.scatter[group].factor,
            }
            for group, value in found.tau.items()
        ],
        "held_out": {
            key: {
                "arms": len(one.alone),
                "alone_percent": _finite(one.totals[0]),
                "pooled_percent": _finite(one.totals[1]),
                "gain": _finite(one.gain),
                "pooling_helps": one.helps,
                "per_arm": {arm: [one.alone[arm], one.pooled[arm]] for arm in one.alone},
            }
            for key, one in (("several_recordings", result.several), ("one_recording", result.single))
        },
        "changes": [
            {
                "arm": one.arm,
                "what": group_name(one.group, described),
                "kind": "drift" if one.drift else "step",
                "after": _when(one.before),
                "until": _when(one.after),
                "first_recording": reduced.arms[one.arm][one.at].name,
                "sigma": float(np.sqrt(one.statistic)),
                "p": one.p,
                "joint": described.model.chain.names[one.joint],
                "torque_share": one.torque_share,
                "residual_share": one.residual_share,
                "step": dict(
                    zip([base.expressions[k] for k in described.groups[one.group]], one.step.tolist(), strict=True)
                ),
            }
            for one in sorted(result.changed, key=lambda one: (one.p, -one.statistic))
        ],
        "tested": {"changes": len(result.compared.changes), "unlike": len(result.compared.odd), "alpha": ALPHA},
        "dependences": [
            {
                "condition": one.condition,
                "expression": base.expressions[one.place],
                "unit": base.units[one.place],
                "slope": one.slope,
                "deviation": one.deviation,
                "p": one.p,
                "recordings": one.recordings,
            }
            for one in result.compared.dependences
        ],
        "software": f"ident-service {__version__}",
    }


_SCHEMA = pa.schema(
    [
        pa.field("arm", pa.string(), nullable=False),
        pa.field("recording", pa.string()),  # null: the arm's estimate from all of them
        pa.field("sha256", pa.string()),
        pa.field("time", pa.timestamp("us", tz="UTC")),
        pa.field("parameter", pa.string(), nullable=False),
        pa.field("group", pa.string(), nullable=False),
        pa.field("unit", pa.string(), nullable=False),
        pa.field("value", pa.float64(), nullable=False),
        pa.field("deviation", pa.float64()),  # null: not seen
        pa.field("verdict", pa.string(), nullable=False),
        pa.field("quality", pa.string(), nullable=False),
        pa.field("torque_error_percent", pa.float64(), nullable=False),
        pa.field("temperature", pa.float64()),
        pa.field("operating_hours", pa.float64()),
    ]
)


def write_table(path: Path, result: FleetResult, summaries: Summaries) -> None:
    """Write `path` as a Parquet table: a row per parameter of each recording's own estimate and each arm's."""
    described, base = result.reduced.described, result.reduced.described.base
    size = base.size
    names = {k: group_name(group, described) for group, places in described.groups.items() for k in places}
    columns = {
        "parameter": list(base.expressions),
        "group": [names[k] for k in range(size)],
        "unit": list(base.units),
    }
    # In pieces, so that memory does not grow with the fleet.
    with pq.ParquetWriter(path, _SCHEMA) as writer:
        for arm, recordings in result.reduced.arms.items():
            summary = summaries[arm]
            own = {
                "recording": None,
                "sha256": None,
                "time": None,
                "value": summary["values"],
                "deviation": summary["standard_deviations"],
                "verdict": summary["verdicts"],
                "quality": "; ".join(summary["unusable"]) or "good",
                "torque_error_percent": summary["error_percent"],
                "temperature": None,
                "operating_hours": None,
            }
            for begin in range(0, len(recordings) + 1, _WRITTEN):
                entries: list[dict[str, Any]] = [
                    _of_recording(one, summary) for one in recordings[begin : begin + _WRITTEN]
                ]
                if begin + _WRITTEN > len(recordings):
                    entries.append(own)
                whole = [
                    {key: value if isinstance(value, list) else [value] * size for key, value in entry.items()}
                    | {"arm": [arm] * size, **columns}
                    for entry in entries
                ]
                values = [_column(field.type, [one for part in whole for one in part[field.name]]) for field in _SCHEMA]
                writer.write_table(pa.Table.from_arrays(values, schema=_SCHEMA))


def _column(kind: pa.DataType, values: Sequence[Any]) -> pa.Array:
    """Return text, numbers or whole numbers, None where there is none, as a column.

    The conversions of pyarrow load pandas for a second where it is installed, to see whether values are of it.
    """
    known = np.array([value is not None for value in values])
    validity = None if known.all() else pa.py_buffer(np.packbits(known, bitorder="little"))
    if pa.types.is_string(kind):
        texts = [b"" if value is None else value.encode() for value in values]
        offsets = np.cumsum([0, *map(len, texts)], dtype=np.int32)
        buffers = [validity, pa.py_buffer(offsets), pa.py_buffer(b"".join(texts))]
    else:
        of = np.float64 if pa.types.is_floating(kind) else np.int64
        buffers = [validity, pa.py_buffer(np.array([0 if value is None else value for value in values], dtype=of))]
    return pa.Array.from_buffers(kind, len(values), buffers)


def _of_recording(one: Recorded, summary: Mapping[str, Any]) -> dict[str, Any]:
    row = one.row
    return {
        "recording": one.name,
        "sha256": row.sha256,
        "time": round(one.at * 1e6),
        "value": row.beta.tolist(),
        "deviation": [_finite(value) for value in row.deviations],
        "verdict": list(verdicts(row.beta, row.deviations, summary["negligible"])),
        "quality": "; ".join(row.warnings) or "good",
        "torque_error_percent": row.error,
        "temperature": row.conditions.get("temperature"),
        "operating_hours": row.conditions.get("operating_hours"),
    }


def drawing(points: Array, fleet_mean: float, change: Change | None) -> dict[str, Any]:
    """Return the pixel coordinates of one small plot: values with intervals over time, fleet's mean, a change."""
    low, high = float((points[:, 1] - points[:, 2]).min()), float((points[:, 1] + points[:, 2]).max())
    low, high = min(low, fleet_mean), max(high, fleet_mean)
    first, last = float(points[0, 0]), float(points[-1, 0])
    room = (high - low) or 1.0

    def x(at: float) -> float:
        return round(6.0 + (WIDTH - 12.0) * ((at - first) / ((last - first) or 1.0)), 1)

    def y(value: float) -> float:
        return round(6.0 + (HEIGHT - 12.0) * (1.0 - (value - low) / room), 1)

    return {
        "bars": [(x(at), y(value - half), y(value + half), y(value)) for at, value, half in points.tolist()],
        "line": " ".join(f"{x(at)},{y(value)}" for at, value, _ in points.tolist()),
        "common": y(fleet_mean),
        "change": None if change is None or change.drift else x(0.5 * (change.before + change.after)),
        "drift": change is not None and change.drift,
        "low": f"{low:.3g}",
        "high": f"{high:.3g}",
        "first": _when(first)[:10],
        "last": _when(last)[:10],
    }


def arm_trends(
    arm: str, reduced: Reduced, compared: Compared, common_beta: Array, most_groups: int | None = None
) -> list[dict[str, Any]]:
    """Return small plots of one arm: per group the parameter that changed most, likeliest changes first.

    Args:
        arm: name.
        reduced: fleet with its recordings.
        compared: the tests over time.
        common_beta: base parameters that are common [SI], shape (base,).
        most_groups: number of groups; all when None.
    """
    described, groups = reduced.described, reduced.described.groups
    numbers = {group: number for number, group in enumerate(groups)}
    of_arm = sorted(compared.changes_of(arm), key=lambda one: (one.p, -one.statistic))
    figures = []
    for one in of_arm[:most_groups]:
        index = int(np.argmax(np.abs(one.step) / np.maximum(one.deviations, np.finfo(float).tiny)))
        place = groups[one.group][index]
        points = parameter_series(reduced.arms[arm], place, numbers[one.group], index, compared.scatter[one.group])
        thin = points[np.unique(np.linspace(0, len(points) - 1, min(len(points), _POINTS)).round().astype(int))]
        what = f"{described.base.expressions[place]} [{described.base.units[place] or '-'}]"
        title = group_name(one.group, described)
        drawn = drawing(thin, float(common_beta[place]), one if one.changed else None)
        figures.append({"what": what, "title": title, "p": one.p, "changed": one.changed, **drawn})
    return figures


def shown_of(arm: str, reduced: Reduced, compared: Compared, common_beta: Array) -> ArmShown:
    """Return what an arm's page shows besides its estimate: its recordings (of many, those with warnings), trends."""
    rows = []
    for one in reduced.arms[arm]:
        row, when = one.row, _when(one.at)[:16].replace("T", " ")
        rows.append((one.name, when, row.seconds, row.rate, row.error, "; ".join(row.warnings)))
    listed = rows if len(rows) <= _ALL_LISTED else [one for one in rows if one[-1]]
    return ArmShown(arm, listed, arm_trends(arm, reduced, compared, common_beta))


def _trends(result: FleetResult) -> list[dict[str, Any]]:
    changed = {one.arm for one in result.changed}
    order = sorted(result.document["ranking"], key=lambda arm: arm not in changed)[:_ARMS_DRAWN]
    drawn = []
    for arm in order:
        figures = arm_trends(arm, result.reduced, result.compared, result.found.common, _GROUPS_DRAWN)
        if figures:
            drawn.append({"arm": arm, "drawn": multiples(arm, figures), "changed": arm in changed})
    return drawn


def fleet_page(result: FleetResult, request: FleetRequest) -> str:
    """Return the fleet's HTML page: one file, no network, readable without scripts."""
    document = result.document
    qualities = [
        {
            "arm": arm,
            "name": one.name,
            "report": _report_beside(one.url),
            "at": _when(one.at)[:16].replace("T", " "),
            "seconds": one.row.seconds,
            "rate": one.row.rate,
            "error": one.row.error,
            "words": "; ".join(one.row.warnings),
        }
        for arm, recordings in result.reduced.arms.items()
        for one in recordings
    ]
    # Of many recordings those that have something to tell; the table has all.
    listed = [one for one in qualities if one["words"]] if len(qualities) > _ALL_LISTED else qualities
    return (
        environment()
        .get_template("fleet.html")
        .render(
            document=document,
            style=files("ident_service.results.report").joinpath("report.css").read_text(encoding="utf-8"),
            trends=_trends(result),
            qualities=listed,
            recordings=len(qualities),
            patterns=request.patterns,
            table=TABLE,
        )
    )


def _report_beside(url: str) -> str | None:
    """Return the address of the report in a local recording's folder, as ident leaves it there; None without one."""
    page = Path(url).with_name("report.html")
    return page.absolute().as_uri() if "://" not in url and page.is_file() else None
