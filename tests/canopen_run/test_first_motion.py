"""The page `docs/first-motion.md`: its description, over emulated drives, by the commands of its table."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml

from ident_service.cli import main, parser

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "first-motion.md").read_text(encoding="utf-8")
SHEETS = ROOT.parent / "shared" / "data" / "eds"


def bench(folder: Path) -> Path:
    """The page's emulated description beside that of the bench and a drive's file, in virtual time."""
    described, emulated = re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)
    (folder / "drive.eds").write_bytes((SHEETS / "maxon_epos4_50-5_0170h.eds").read_bytes())
    (folder / "bench.yaml").write_text(described)
    tree = yaml.safe_load(emulated)
    # On the page the drives are a process of their own.
    assert tree["driver"]["buses"] == [{"interface": "ident_wire", "channel": "bench"}]
    tree["driver"]["buses"] = [{"interface": "lock_step"}]
    path = folder / "emulated.yaml"
    path.write_text(yaml.safe_dump(tree))
    return path


def test_every_command_of_the_page_is_one(tmp_path: Path) -> None:
    commands = re.findall(r"`(ident [^`]+)`|^(ident .+)$", PAGE, re.MULTILINE)
    words = [(one or other).split()[1:] for one, other in commands]
    assert len(words) > 14
    for one in words:
        if {"bench.yaml", "emulated.yaml"} & set(one):
            parser().parse_args(one)


@pytest.mark.campaign
@pytest.mark.slow
@pytest.mark.skipif(not SHEETS.is_dir(), reason="the makers' data sheets are not beside this checkout")
def test_the_pages_pendulum_is_commissioned(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arm, state, run = bench(tmp_path), ["--state", str(tmp_path / "state")], tmp_path / "run"
    assert main(["bus", "probe", str(arm), "--eds", str(tmp_path / "drive.eds"), *state]) == 0
    assert "can be driven, predicted from its EDS" in capsys.readouterr().out
    assert main(["config", "check", str(arm)]) == 0
    assert main(["preflight", str(arm), "--home", "--confirm", "emulated", *state]) == 0, capsys.readouterr().out
    assert main(["preflight", str(arm), "--confirm", "emulated", *state]) == 0, capsys.readouterr().out
    assert main(["run", str(arm), "--out", str(run), "--can-log", *state]) == 0
    assert main(["identify", str(run / "run.mcap"), "--arm", str(arm), "--out", str(tmp_path / "result"), *state]) == 0
