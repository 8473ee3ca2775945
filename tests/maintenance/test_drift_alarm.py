"""Is it still the arm that was accepted? By the command, on a simulated arm whose elbow got drier or did not."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from helpers.examples import NIGHT
from maintenance.conftest import ARM
from maintenance.drifting import reidentified

from ident_service.cli import main
from ident_service.operations.drift_alarms import alarms
from ident_service.operations.maintenance_schedule import DueRule, add_schedule, pending
from ident_service.registry.database import Database, audit_log
from ident_service.registry.state_folder import arm_fault_store
from ident_service.results.manifest import verified_files

DRIER = 1.3
SEEDS = 20


@pytest.mark.campaign
@pytest.mark.campaign
def test_an_unchanged_arm_is_due_no_more_and_raises_nothing(
    db: Database, state: Path, accepted: str, capsys: pytest.CaptureFixture[str]
) -> None:
    add_schedule(db, ARM, DueRule(maintenance=True), "me", 0.0)
    assert main(["maintenance", ARM, "--what", "gear oil changed", "--state", str(state)]) == 0
    assert "gear oil changed" in capsys.readouterr().out
    assert len(pending(db)) == 1
    again = reidentified(state, 11, 1.0, lambda: capsys.readouterr().out)
    assert (again.code, again.answer["verdict"], again.alarms) == (0, "unchanged", [])
    assert pending(db) == []
    assert main(["alarm", "list", "--state", str(state)]) == 0


@pytest.mark.slow
def test_a_drier_joint_raises_an_alarm_that_stands_until_a_person_acts(
    db: Database, state: Path, accepted: str, capsys: pytest.CaptureFixture[str]
) -> None:
    current = (state / "arms" / ARM / "current" / "parameters.json").read_bytes()
    again = reidentified(state, 21, DRIER, lambda: capsys.readouterr().out)
    assert again.names_the_elbow_alone
    assert (state / "arms" / ARM / "current" / "parameters.json").read_bytes() == current
    errors = again.answer["comparison"]["compared"][0]["torque_error_percent"]
    assert errors["reference"]["whole"] > 3.0 * errors["own"]["whole"]
    # The comparison is part of the run, and the registry has both of its runs and the verdict.
    run = state / "runs" / again.answer["run"]
    assert {"comparison.json", "comparison.html", "comparison.txt"} <= set(verified_files(run))
    (row,) = db.rows("SELECT * FROM reidentifications")
    assert (row["state"], row["run"], row["begun_by"]) == ("changed", run.name, "terminal:ann")
    assert {one["id"] for one in db.rows("SELECT id FROM runs")} >= {row["run"], row["recorded"]}
    driven = db.row("SELECT seconds FROM runs WHERE id = ?", row["recorded"])
    assert driven is not None
    assert 20.0 < driven["seconds"] < 40.0  # the motion of twenty seconds, and the ways there and back

    assert main(["alarm", "list", "--state", str(state)]) == 3
    assert main(["alarm", "ack", "1", "--note", "seal ordered", "--by", "bob", "--state", str(state)]) == 0
    assert alarms(db) == []
    if not NIGHT:
        return  # what comes now takes two motions more
    # It drifted still, so it is found again; accepting the new set ends it, and then the arm is as accepted.
    second = reidentified(state, 22, DRIER, lambda: capsys.readouterr().out)
    assert second.names_the_elbow_alone
    folder = state / "runs" / second.answer["run"]
    assert main(["accept", str(folder), "--note", "new seal, dry", "--by", "ann", "--state", str(state)]) == 0
    assert alarms(db) == []
    assert alarms(db, closed=True)[0]["closed_by"] == "terminal:ann"
    assert reidentified(state, 23, DRIER, lambda: capsys.readouterr().out).code == 0
    told = [line["what"] for line in audit_log(db, max_lines=500)]
    assert told.count("drift alarm") == 2
    assert told.count("alarm acknowledged") == 1


@pytest.mark.slow
def test_without_a_typed_name_or_something_accepted_nothing_moves(
    db: Database, state: Path, accepted: str, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["reidentify", "--json", "--state", str(state)]
    assert main([*words, "planar2", "--confirm", "planar2"]) == 2
    assert "nothing has been accepted" in json.loads(capsys.readouterr().out)["error"]["message"]
    arm = next(state.glob("descriptions/quick-*/arm.yaml"))
    assert main([*words, str(arm), "--confirm", "quack"]) == 2  # 3 would mean that it has changed
    assert "the arm is quick; nothing has moved" in json.loads(capsys.readouterr().out)["error"]["message"]
    arm_fault_store(state, "quick").latch("lease_lost", "nobody was there")
    assert main([*words, str(arm), "--confirm", "quick"]) == 5
    assert [path.name for path in (state / "runs").iterdir()] == [accepted]
    assert db.rows("SELECT * FROM reidentifications") == []


@pytest.mark.campaign
@pytest.mark.parametrize(("drier", "first"), [(1.0, 1000), (DRIER, 2000)], ids=["unchanged", "drier"])
def test_twenty_seeds(
    db: Database, state: Path, accepted: str, capsys: pytest.CaptureFixture[str], drier: float, first: int
) -> None:
    found = []
    for seed in range(first, first + SEEDS):
        db.write("UPDATE alarms SET closed = 1 WHERE closed IS NULL")
        found.append(reidentified(state, seed, drier, lambda: capsys.readouterr().out))
    if drier == 1.0:
        assert sum(bool(one.alarms) for one in found) <= 1
        assert all(one.answer["verdict"] in ("unchanged", "changed") for one in found)
    else:
        assert sum(one.names_the_elbow_alone for one in found) >= SEEDS - 1
