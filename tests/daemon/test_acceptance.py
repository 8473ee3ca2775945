"""What a person accepts: whole folders, a current set under a path that stays, and what a kill in between leaves."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from ident_service.config.load import arm_from_json
from ident_service.daemon.jobs.commands import accepted_description
from ident_service.errors import MustNotBeUsed, ParameterError, UnknownId, UsageError
from ident_service.operations.acceptance import accept, acceptances, rollback, synchronise
from ident_service.operations.run_archive import import_run, prunable_recordings, prune
from ident_service.registry import jobs as rows
from ident_service.registry.database import Database
from ident_service.registry.runs import (
    index_run,
    known_run,
    parameter_set,
    rebuild_runs,
    recordings,
    run_file,
    run_files,
)
from ident_service.results.manifest import MANIFEST, write_manifest

pytestmark = pytest.mark.slow


@pytest.fixture
def db(state: Path) -> Iterator[Database]:
    with Database(state) as opened:
        yield opened


@pytest.fixture
def folder(commissioned: Path, tmp_path: Path) -> Path:
    """A copy of a run's folder, which may be changed."""
    return Path(shutil.copytree(commissioned, tmp_path / "other-machine" / "20260101T000000Z-quick"))


def current(state: Path) -> Path:
    return state / "arms" / "quick" / "current" / "parameters.json"


def test_a_kill_after_the_act_and_before_what_follows_is_made_good(db: Database, state: Path, folder: Path) -> None:
    accept(db, state, folder, "good", "me")
    first = current(state).read_bytes()
    document = json.loads((folder / "parameters.json").read_text())
    (folder / "parameters.json").write_text(json.dumps(document | {"method": "huber"}))
    write_manifest(folder)
    accept(db, state, folder, "better", "me")
    # As a kill between the folder and what follows it leaves things:
    current(state).write_bytes(first)
    db.write("DELETE FROM acceptances WHERE number = 2")
    synchronise(db, state)
    assert json.loads(current(state).read_text())["method"] == "huber"
    assert [row["number"] for row in db.rows("SELECT number FROM acceptances ORDER BY number")] == [1, 2]
    # And before the act, half a folder is no act.
    half = state / "arms" / "quick" / "accepted" / ".0003.abcd.partial"
    half.mkdir()
    synchronise(db, state)
    assert len(acceptances(state, "quick")) == 2


def test_what_was_identified_with_code_is_not_identified_again_by_a_daemon(
    db: Database, state: Path, folder: Path
) -> None:
    accept(db, state, folder, "good", "me")
    assert accepted_description(state, "quick", 1).name == "arm.json"
    config = arm_from_json(folder / "arm.json")
    extended = config.model_copy(update={"constraints": config.constraints.model_copy(update={"custom": "some:code"})})
    (folder / "arm.json").write_text(extended.model_dump_json())
    document = json.loads((folder / "parameters.json").read_text())
    document["arm"]["sha256"] = extended.sha256
    (folder / "parameters.json").write_text(json.dumps(document))
    write_manifest(folder)
    accept(db, state, folder, "from another machine", "me")
    with pytest.raises(UsageError, match=r"identified with code \(constraints.custom: some:code\)"):
        accepted_description(state, "quick", 2)


def test_what_is_not_whole_or_not_feasible_is_not_accepted(db: Database, state: Path, folder: Path) -> None:
    (folder / "score.json").write_text("{}")
    with pytest.raises(ParameterError, match="changed"):
        accept(db, state, folder, "good", "me")
    document = json.loads((folder / "parameters.json").read_text())
    document["feasibility"]["feasible"] = False
    (folder / "parameters.json").write_text(json.dumps(document))
    write_manifest(folder)
    with pytest.raises(MustNotBeUsed, match="are not feasible"):
        accept(db, state, folder, "good", "me")
    for note in ("", " \n", "x" * 2001):
        with pytest.raises(UsageError, match="note"):
            accept(db, state, folder, note, "me")
    assert not current(state).exists()
    with pytest.raises(UsageError, match="nothing has been accepted"):
        rollback(db, state, "quick", "back", "me")


@pytest.mark.parametrize("forged", ["lighter", "certificate", "covariance"])
def test_what_is_accepted_proves_itself(db: Database, state: Path, folder: Path, forged: str) -> None:
    """A manifest is made again by whoever forges; the certificate is not."""
    document = json.loads((folder / "parameters.json").read_text())
    if forged == "lighter":
        document["base_parameters"]["values"][0] = -1.0
    elif forged == "certificate":
        certificate = document["feasibility"]["certificate"]
        certificate["kind"] = "dual" if certificate["kind"] == "witness" else "witness"
    else:
        document["base_parameters"]["covariance"][0][1] += 1.0
    (folder / "parameters.json").write_text(json.dumps(document))
    write_manifest(folder)
    with pytest.raises(ParameterError if forged == "covariance" else MustNotBeUsed):
        accept(db, state, folder, "trust me", "me")
    assert acceptances(state, "quick") == []


@pytest.mark.parametrize("name", ["nobody", "../../elsewhere"])
def test_nothing_is_made_for_an_arm_of_which_nothing_was_accepted(db: Database, state: Path, name: str) -> None:
    before = sorted(state.parent.rglob("*"))
    with pytest.raises(UsageError, match="nothing has been accepted yet"):
        rollback(db, state, name, "back", "me")
    assert sorted(state.parent.rglob("*")) == before


def test_a_set_that_was_changed_behind_our_back_is_not_rolled_back_to(db: Database, state: Path, folder: Path) -> None:
    accept(db, state, folder, "one", "me")
    accept(db, state, folder, "two", "me")
    (state / "arms" / "quick" / "accepted" / "0001" / "parameters.json").write_text("{}")
    with pytest.raises(ParameterError, match="was changed since"):
        rollback(db, state, "quick", "back", "me")
    with pytest.raises(UsageError, match="from 1 to 2"):
        rollback(db, state, "quick", "back", "me", acceptance_number=3)


def test_a_folder_from_another_machine_is_imported_whole(db: Database, state: Path, folder: Path) -> None:
    (folder / "stray").write_text("not in the manifest")
    row = import_run(db, state, folder, "me")
    assert (row["arm"], row["kind"], row["ending"]) == ("quick", "simulation", "done")
    copy = state / "runs" / folder.name
    assert not (copy / "stray").exists()
    assert run_files(db, state, row["id"]) == json.loads((folder / MANIFEST).read_text())["files"]
    assert import_run(db, state, folder, "me")["id"] == row["id"]  # again is no mistake
    found = parameter_set(db, row["id"])
    assert found is not None
    assert found["feasible"] == 1
    with pytest.raises(UnknownId):
        run_file(db, state, row["id"], "../../token")
    # The registry can be made again from the folders.
    db.write("DELETE FROM runs")
    assert rebuild_runs(db, state) == []
    assert known_run(db, row["id"])["manifest_sha256"] == row["manifest_sha256"]


def test_what_is_torn_foreign_or_leads_elsewhere_is_not_imported(db: Database, state: Path, folder: Path) -> None:
    names = list(json.loads((folder / MANIFEST).read_text())["files"])
    secret = folder.parent / "secret"
    secret.write_text("of this machine")

    def tried(words: str, *kinds: type[Exception]) -> None:
        with pytest.raises(kinds or (ParameterError,), match=words):
            import_run(db, state, folder, "me")
        assert not (state / "runs" / folder.name).exists()

    good = (folder / "report.txt").read_bytes()
    (folder / "report.txt").write_bytes(good[:-1])
    tried("changed, or is torn")
    (folder / "report.txt").unlink()
    tried("not there")
    (folder / "report.txt").symlink_to(secret)
    tried("a link")
    (folder / "report.txt").unlink()
    (folder / "report.txt").write_bytes(good)
    whole = (folder / MANIFEST).read_text()
    for name in ("../secret", "/etc/hostname", "..", "a/b", MANIFEST):
        (folder / MANIFEST).write_text(whole.replace('"report.txt"', json.dumps(name)))
        tried("not the manifest of a run")
    (folder / MANIFEST).write_text(whole.replace("ident-run", "other"))
    tried("not the manifest of a run")
    (folder / MANIFEST).write_text("[" * 100_000)
    tried("not a manifest")
    (folder / MANIFEST).unlink()
    tried("no manifest", UsageError)
    assert names
    link = folder.parent / "link"
    link.symlink_to(folder)
    with pytest.raises(UsageError, match="a link"):
        import_run(db, state, link, "me")


def test_another_run_of_the_same_name_stays(db: Database, state: Path, folder: Path) -> None:
    import_run(db, state, folder, "me")
    (folder / "report.txt").write_text("another")
    write_manifest(folder)
    with pytest.raises(UsageError, match="another run of this name"):
        import_run(db, state, folder, "me")
    assert (state / "runs" / folder.name / "report.txt").read_text() != "another"


def test_only_recordings_that_nobody_accepted_are_let_go(db: Database, state: Path, folder: Path) -> None:
    for day in range(1, 6):
        named = folder.rename(folder.with_name(f"2026010{day}T000000Z-quick"))
        import_run(db, state, named, "me")
        db.write("UPDATE runs SET created = ? WHERE id = ?", float(day), named.name)
        folder = named
    accept(db, state, state / "runs" / "20260101T000000Z-quick", "kept for ever", "me")
    # A run that holds no recording, an identification say, takes nobody's place.
    bare = folder.with_name("20260109T000000Z-quick")
    shutil.copytree(folder, bare, ignore=shutil.ignore_patterns("*.mcap"))
    write_manifest(bare)
    import_run(db, state, bare, "me")
    gone = prunable_recordings(db, state, 2)
    assert {one.run[:8] for one in gone} == {"20260102", "20260103"}
    assert {one.name for one in gone} == {"identification.mcap", "validation.mcap"}
    assert all((state / "runs" / one.run / one.name).is_file() for one in gone)  # a dry run
    assert prune(db, state, 2, "me") == gone
    assert not any((state / "runs" / one.run / one.name).exists() for one in gone)
    assert prunable_recordings(db, state, 2) == []
    # What stays is still what the manifest names, and the row keeps the hash of what went.
    row = index_run(db, state, gone[0].run)
    assert row["ending"] == "done"
    assert all(one["deleted"] and len(one["sha256"]) == 64 for one in recordings(db, gone[0].run))
    assert (state / "runs" / gone[0].run / "parameters.json").is_file()
    assert "identification.mcap" not in run_files(db, state, gone[0].run)


def test_recordings_behind_an_accepted_set_of_another_run_stay(db: Database, state: Path, folder: Path) -> None:
    # As over the API: each recording is a run, and the identification another one.
    identified = folder.rename(folder.with_name("20260101T000000Z-quick"))
    named = json.loads((identified / "parameters.json").read_text())
    wanted = {one["name"] for one in (*named["provenance"]["recordings"],)}
    judged = {Path(one["recording"]).name for one in named["validation"]}
    assert wanted == {"identification.mcap"}
    assert judged == {"validation.mcap"}
    for number, name in enumerate(("identification.mcap", "validation.mcap", "other.mcap")):
        recorded = folder.with_name(f"2025010{number + 1}T000000Z-quick")
        recorded.mkdir()
        shutil.copyfile(identified / "arm.json", recorded / "arm.json")
        if name != "other.mcap":
            shutil.copyfile(identified / name, recorded / name)
        else:
            (recorded / name).write_bytes((identified / "validation.mcap").read_bytes()[:-1])
        write_manifest(recorded)
        import_run(db, state, recorded, "me")
    for name in ("identification.mcap", "validation.mcap"):
        (identified / name).unlink()
    write_manifest(identified)
    import_run(db, state, identified, "me")
    assert {one.run[:8] for one in prunable_recordings(db, state, 0)} == {"20250101", "20250102", "20250103"}
    accept(db, state, state / "runs" / identified.name, "kept for ever", "me")
    assert [one.run[:8] for one in prune(db, state, 0, "me")] == ["20250103"]
    # An earlier set stays one that can be rolled back to.
    document = json.loads((identified / "parameters.json").read_text())
    document["provenance"]["recordings"] = document["validation"] = []
    (identified / "parameters.json").write_text(json.dumps(document))
    write_manifest(identified)
    accept(db, state, identified, "from elsewhere", "me")
    assert prunable_recordings(db, state, 0) == []
    gone = "20250103T000000Z-quick"
    with pytest.raises(UnknownId, match=r"was deleted on \d{4}-\d\d-\d\d to make room \(`ident prune`\)"):
        run_file(db, state, gone, "other.mcap")
    with pytest.raises(UnknownId, match="manifest names them"):
        run_file(db, state, gone, "never.mcap")


def test_recordings_that_a_job_reads_stay(db: Database, state: Path, folder: Path) -> None:
    import_run(db, state, folder, "me")
    asked = {"kind": "identify", "recordings": [{"run": folder.name}]}
    job = rows.add_job(db, "identify-1", "identify", "quick", asked, [], "me", motion=False, run_id="another")
    assert prunable_recordings(db, state, 0) == []
    rows.mark_ended(db, job["id"], "done", "", 0)
    assert {one.run for one in prunable_recordings(db, state, 0)} == {folder.name}
