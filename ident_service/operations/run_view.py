"""Show a run in Rerun: the arm in its surroundings, its joints over time, and what a model leaves of their torques.

Each recording is a branch of entities of its own, all of them on one time axis, seconds since their first sample.

======================== ==========================================================================
entity                   content
======================== ==========================================================================
NAME/arm/base, JOINT     pose of each joint's frame, and the solids or meshes that stand still in it
NAME/surroundings        obstacles of the workspace
NAME/position/JOINT      measured [rad or m]
NAME/reference/JOINT     asked for, in this package's own recordings
NAME/velocity/JOINT      measured [rad/s or m/s], where the drives tell it
NAME/torque/JOINT        commanded, or of a recording of others recorded [N m or N]
NAME/residual/JOINT      torque that the identified parameters leave: lowest and highest of a stretch of time
NAME/events              states and faults of the motion
======================== ==========================================================================
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ident_service.config.arm import ArmConfig
from ident_service.config.load import arm_from_json
from ident_service.errors import UsageError
from ident_service.model.appearance import Mesh, visible_bodies, visual_meshes
from ident_service.model.arm_model import ArmModel, arm_model
from ident_service.model.chain import WORLD, Array
from ident_service.model.collision import surroundings
from ident_service.model.kinematics import joint_frames
from ident_service.model.solids import Body, Capsule, Cylinder, HalfSpace
from ident_service.model.urdf import rotation_to
from ident_service.recordings.files import sha256
from ident_service.recordings.mcap_follower import RecordingFollower
from ident_service.recordings.mcap_reader import McapRecording
from ident_service.recordings.open import open_recording
from ident_service.recordings.recording import Recording
from ident_service.results.evidence.evidence import PredictionTrace
from ident_service.results.manifest import require_folder_of
from ident_service.results.report_files import read_evidence_of, read_reported
from ident_service.results.run_folder import ARM, PARAMETERS

TIMELINE = "time"
_POSES_HZ = 50.0
_FLOOR = 1.5  # m, half the edge of the square by which a half space is shown
_LINK, _BASE, _AROUND = (216, 153, 64, 255), (90, 97, 107, 255), (120, 140, 160, 90)
_LEVELS = {10: "DEBUG", 20: "INFO", 30: "WARN", 40: "ERROR", 50: "CRITICAL"}


@dataclass(frozen=True)
class Viewed:
    """Describe what is shown of a run.

    Attributes:
        recordings: names of the recordings, in order.
        residuals: names of the recordings with residuals.
        saved: the written file, None where a viewer was opened.
    """

    recordings: tuple[str, ...]
    residuals: tuple[str, ...]
    saved: Path | None


@dataclass(frozen=True)
class _Shown:
    name: str
    recording: Recording
    trace: PredictionTrace | None


def show_run_in_viewer(
    folder: Path, recordings: Sequence[Path] = (), save_file: Path | None = None, urdf: Path | None = None
) -> Viewed:
    """Show a run in Rerun's viewer, or write what it would show into a file.

    Args:
        folder: folder made by `ident run`, `simulate` or `identify`.
        recordings: recordings besides those in the folder; results of `identify` have none of their own.
        save_file: file that must not exist; None opens the viewer.
        urdf: URDF with meshes to draw instead of capsules.

    Raises:
        UsageError: Rerun is not installed, there is no display, the file exists, the folder has no arm or recordings,
            or two recordings have one name.
        IdentError: results, recordings or meshes that cannot be read.
    """
    rr = _rerun()
    if save_file is None and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise UsageError(
            "there is no display for Rerun's viewer; write a file with --save FILE.rrd, and open it elsewhere"
        )
    if save_file is not None and save_file.exists():
        raise UsageError(f"{save_file}: exists already; give a file that does not")
    if save_file is not None:
        require_folder_of(save_file)
    config = _config(folder)
    model = arm_model(config)
    shown = list(_recordings(folder, recordings, model))
    meshes = [] if urdf is None else visual_meshes(urdf, config.kinematics, model.chain)
    stream = rr.RecordingStream("ident", recording_id=f"{config.name} {folder.resolve().name}")
    partial = None if save_file is None else save_file.with_name(save_file.name + ".partial")
    try:
        if partial is None:
            stream.spawn(default_blueprint=_layout(model, shown))
        else:
            stream.save(partial, default_blueprint=_layout(model, shown))
        for one in shown:
            _send(stream, one, model, meshes)
        stream.flush()
        stream.disconnect()
        if partial is not None and save_file is not None:
            partial.replace(save_file)
    except BaseException:
        if partial is not None:
            partial.unlink(missing_ok=True)
        raise
    return Viewed(
        tuple(one.name for one in shown), tuple(one.name for one in shown if one.trace is not None), save_file
    )


def _rerun() -> Any:
    try:
        import rerun
    except ImportError:
        raise UsageError("Rerun is not installed: pip install 'ident-service[view]'") from None
    return rerun


def _config(folder: Path) -> ArmConfig:
    if not folder.is_dir():
        raise UsageError(f"{folder}: is no folder; give one of `ident run`, `simulate` or `identify`")
    if not (folder / ARM).is_file():
        raise UsageError(f"{folder}: has no {ARM}; give a folder of `ident run`, `simulate` or `identify`")
    return arm_from_json(folder / ARM)


def _recordings(folder: Path, more: Sequence[Path], model: ArmModel) -> Iterator[_Shown]:
    """Yield the recordings with their residuals, found by the hash of the recording."""
    paths = [*sorted(folder.glob("*.mcap")), *more]
    traces: dict[str, PredictionTrace] = {}
    if (folder / PARAMETERS).is_file():
        results = read_reported(folder)
        traces = {trace.sha256: trace for trace in read_evidence_of(results).recordings}
        if not paths:
            wanted = ", ".join(trace.name for trace in traces.values())
            raise UsageError(f"{folder}: its recordings are elsewhere; name them: --recording FILE, of {wanted}")
    if not paths:
        raise UsageError(f"{folder}: has no recording; name one: --recording FILE")
    names: set[str] = set()
    for path in paths:
        recording = open_recording(
            path, model.chain.names, fmt=model.config.recording, transmission=model.config.transmission
        )
        if path.stem in names:
            raise UsageError(f"{path}: two recordings are called {path.stem!r}; rename one")
        names.add(path.stem)
        yield _Shown(path.stem, recording, traces.get(sha256(path, path.stat().st_size)))


def _send(stream: Any, one: _Shown, model: ArmModel, meshes: Sequence[Mesh]) -> None:
    rr = _rerun()
    blocks = list(one.recording.blocks())
    if not blocks:
        raise UsageError(f"{one.recording.path}: has no samples")
    stamps = np.concatenate([block.stamp_ns for block in blocks])
    position = np.concatenate([block.position for block in blocks])
    torque = np.concatenate([block.torque for block in blocks])
    time = (stamps - stamps[0]) * 1e-9
    _send_arm(stream, one.name, model, meshes)
    _send_poses(stream, one.name, model, time, position)
    _send_series(stream, one.name, "position", model, time, position)
    _send_series(stream, one.name, "torque", model, time, torque)
    velocities = [block.velocity for block in blocks if block.velocity is not None]
    if len(velocities) == len(blocks):
        _send_series(stream, one.name, "velocity", model, time, np.concatenate(velocities))
    if one.trace is not None:
        for name, joint in zip(model.chain.names, one.trace.joints, strict=True):
            path = _path(one.name, "residual", name)
            stream.log(path, rr.SeriesLines(names=[f"{name} lowest", f"{name} highest"]), static=True)
            stream.send_columns(path, [_axis(one.trace.time)], rr.Scalars.columns(scalars=joint.residual.T))
    if not (isinstance(one.recording, McapRecording) and one.recording.own):
        return
    asked, reference = _reference(one.recording, model.chain.names)
    first_ns = int(stamps[0])
    offset_ns = int(one.recording.metadata.get("utc_offset_ns", "0"))
    _send_series(stream, one.name, "reference", model, (asked - offset_ns - first_ns) * 1e-9, reference)
    if events := one.recording.read_extras().events:
        stream.send_columns(
            _path(one.name, "events"),
            [_axis(np.array([(event.stamp_ns - first_ns) * 1e-9 for event in events]))],
            rr.TextLog.columns(
                text=[event.message for event in events], level=[_LEVELS.get(event.level, "INFO") for event in events]
            ),
        )


def _reference(recording: McapRecording, joints: Sequence[str]) -> tuple[Array, Array]:
    """Return stamps [ns since 1970 in UTC] and positions that were asked for, in the order of `joints`."""
    follower = RecordingFollower(recording.path)
    try:
        parts = []
        while (part := follower.read()) is not None:
            parts.append(part)
    finally:
        follower.close()
    order = [follower.joint_names.index(name) for name in joints]
    return (
        np.concatenate([part.stamp_ns for part in parts]),
        np.concatenate([part.reference for part in parts])[:, order],
    )


def _axis(time: Array) -> Any:
    return _rerun().TimeColumn(TIMELINE, duration=time)


def _send_series(stream: Any, name: str, what: str, model: ArmModel, time: Array, values: Array) -> None:
    rr = _rerun()
    for joint, column in zip(model.chain.names, values.T, strict=True):
        path = _path(name, what, joint)
        stream.log(path, rr.SeriesLines(names=[f"{joint} {what}"]), static=True)
        stream.send_columns(path, [_axis(time)], rr.Scalars.columns(scalars=column))


def _send_poses(stream: Any, name: str, model: ArmModel, time: Array, position: Array) -> None:
    rr = _rerun()
    length = max(float(time[-1]), 1e-9)
    chosen = np.unique(np.searchsorted(time, np.arange(0.0, length, 1.0 / _POSES_HZ)))
    turns, places = joint_frames(model.chain, position[chosen])
    for k, joint in enumerate(model.chain.names):
        stream.send_columns(
            _path(name, "arm", joint),
            [_axis(time[chosen])],
            rr.Transform3D.columns(translation=places[:, k], quaternion=Rotation.from_matrix(turns[:, k]).as_quat()),
        )


def _send_arm(stream: Any, name: str, model: ArmModel, meshes: Sequence[Mesh]) -> None:
    rr = _rerun()
    stream.log(_path(name, "arm"), rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    drawn = {mesh.joint for mesh in meshes}
    for number, mesh in enumerate(meshes):
        path = _path(*_owner(name, mesh.joint, model), f"mesh_{number}")
        placed = rr.Transform3D(translation=mesh.translation, mat3x3=mesh.rotation * mesh.scale)
        stream.log(path, placed, static=True)
        stream.log(path, rr.Asset3D(path=mesh.file), static=True)
    for number, body in enumerate(visible_bodies(model)):
        if body.joint not in drawn:
            path = _path(*_owner(name, body.joint, model), f"solid_{number}")
            stream.log(path, _drawn(body, _BASE if body.joint == WORLD else _LINK), static=True)
    for body in surroundings(model):
        stream.log(_path(name, "surroundings", body.owner), _drawn(body, _AROUND), static=True)


def _owner(name: str, joint: int, model: ArmModel) -> tuple[str, ...]:
    return (name, "arm", "base" if joint == WORLD else model.chain.names[joint])


def _path(*parts: str) -> str:
    """Return the path of an entity; names of files and joints may hold what has a meaning in paths."""
    return str(_rerun().new_entity_path(list(parts)))


def _drawn(body: Body, color: tuple[int, int, int, int]) -> Any:
    rr, solid = _rerun(), body.solid
    if isinstance(solid, Capsule):
        along = solid.end - solid.start
        length = float(np.linalg.norm(along))
        turn = rotation_to(along / length) if length > 0.0 else np.eye(3)
        return rr.Capsules3D(
            lengths=[length], radii=[solid.radius], translations=[solid.start], quaternions=[_quaternion(turn)],
            colors=[color],
        )  # fmt: skip
    if isinstance(solid, Cylinder):
        return rr.Cylinders3D(
            lengths=[2.0 * solid.half_length], radii=[solid.radius], centers=[solid.center],
            quaternions=[_quaternion(solid.rotation)], colors=[color],
        )  # fmt: skip
    if isinstance(solid, HalfSpace):
        center, turn = solid.offset * solid.normal, rotation_to(solid.normal)
        half = np.array([_FLOOR, _FLOOR, 1e-3])
    else:
        center, turn, half = solid.center, solid.rotation, solid.half
    fill = rr.components.FillMode.Solid
    return rr.Boxes3D(
        half_sizes=[half], centers=[center], quaternions=[_quaternion(turn)], colors=[color], fill_mode=fill
    )


def _quaternion(turn: Array) -> Array:
    return np.asarray(Rotation.from_matrix(turn).as_quat())


def _layout(model: ArmModel, shown: Sequence[_Shown]) -> Any:
    """Return the viewer's layout: per recording a tab with the arm, and its series below one another."""
    import rerun.blueprint as rrb

    tabs = []
    for one in shown:
        series = []
        for what in ("position", "torque", *(["residual"] if one.trace is not None else [])):
            inside = [f"{_path(one.name, what)}/**"]
            inside += [f"{_path(one.name, 'reference')}/**"] if what == "position" else []
            series.append(rrb.TimeSeriesView(name=what, origin=_path(one.name, what), contents=inside))
        arm = rrb.Spatial3DView(
            name=model.config.name,
            origin=_path(one.name),
            contents=[f"{_path(one.name, 'arm')}/**", f"{_path(one.name, 'surroundings')}/**"],
        )
        events = rrb.TextLogView(name="events", origin=_path(one.name, "events"))
        left = rrb.Vertical(arm, events, row_shares=[4, 1])
        tabs.append(rrb.Horizontal(left, rrb.Vertical(*series), name=one.name, column_shares=[2, 3]))
    return rrb.Blueprint(rrb.Tabs(*tabs), rrb.TimePanel(timeline=TIMELINE), collapse_panels=True)
