"""A daemon's registry as the source of a fleet: `ident fleet identify --server`."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from daemon.served import daemon_process
from helpers.fleets import BEGIN, WEEK, kind, write_recording

from ident_service.cli import main
from ident_service.config.yaml_source import shipped_arms
from ident_service.errors import UsageError

pytestmark = pytest.mark.slow
RECORDINGS, SINCE = 6, 3


@pytest.mark.campaign
def test_the_registry_of_a_daemon_is_a_fleet(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    of, state = kind(rate=100.0, seconds=12.0), tmp_path / "state"
    with daemon_process(state) as (_, client):
        names = of.model.layout.names
        for number, (name, count) in enumerate((("cell1", RECORDINGS), ("cell2", RECORDINGS), ("other", 1))):
            client.add_arm(shipped_arms()["planar2"].read_text().replace("name: planar2", f"name: {name}"))
            for week in range(count):
                path, delta = tmp_path / name / f"week{week}.mcap", of.individual(number)
                if name == "cell2" and week >= SINCE:
                    delta[[names.index("fv2"), names.index("fc2")]] *= 1.5
                write_recording(of, path, delta, seed=10 * number + week, at=BEGIN + week * WEEK)
                client.upload(name, path)
        out, there = tmp_path / "out", ["--server", client.url, "--state", str(state)]
        words = ["fleet", "identify", "cell*", "--arm", "planar2"]
        capsys.readouterr()
        assert main([*words, *there, "--out", str(out)]) == 3, "an arm changed"
        said = capsys.readouterr().out
        assert "12 recordings of 2 arms, 0 left out" in said
        assert f"files: {out}" in said
        document = json.loads((out / "fleet.json").read_text())
        assert {arm: one["recordings"] for arm, one in document["arms"].items()} == {"cell1": 6, "cell2": 6}
        assert {path.name for path in out.iterdir()} == {
            *("fleet.html", "fleet.json", "parameters.parquet", "problems.json")
        }
        job = next(client.jobs())
        assert (job.kind, job.state) == ("fleet", "refused")
        folder = state / "exports" / str(job.run)
        assert (folder / "arms" / "cell1" / "parameters.json").is_file()
        # The alarm stands in the daemon's table, as one of a re-identification does.
        (alarm,) = client.pages("/api/v1/alarms")
        assert (alarm["arm"], alarm["run"], alarm["closed"]) == ("cell2", job.run, None)
        assert alarm["what"].startswith("changed: friction of joint elbow, as its recordings in a fleet show: a step")
        page = client.content("/arms/cell2").decode()
        assert "friction of joint elbow" in page
        assert f'<a href="/jobs/{job.id}">The fleet' in page
        with pytest.raises(UsageError, match="has no recording of such arms"):
            client.compute("fleet", arm="planar2", arms=["nobody*"])
    assert main([*words, *there, "--workers", "2"]) == 2
    assert "--workers cannot be sent to a daemon" in capsys.readouterr().err
