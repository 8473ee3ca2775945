"""`constraints.custom` and the second opinion: the documented example, known equivalents, what goes wrong."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from estimation.synthetic import SampledRecording, exact_torque, random_information, stamps, waves

from ident_service.cli import main
from ident_service.config.arm import Constraints
from ident_service.config.load import arm_from_json, load_arm
from ident_service.errors import ConfigError, UsageError
from ident_service.estimation.custom import CustomError, CustomFunction, load_custom
from ident_service.estimation.feasible.convex import available_solvers, convex_least_squares, second_opinion
from ident_service.estimation.feasible.feasible_set import feasible_set
from ident_service.estimation.feasible.priors import Prior
from ident_service.estimation.feasible.problems import constrained_least_squares
from ident_service.estimation.identify import Estimate, identify
from ident_service.estimation.least_squares import ordinary_least_squares
from ident_service.model.arm_model import ArmModel, arm_model
from ident_service.model.base_parameters import base_parameters
from ident_service.operations.identification import Request, identify_files
from ident_service.results.assessment import assess
from ident_service.results.parameter_file import convex_document
from ident_service.results.summary import summary

DOCUMENT = Path(__file__).parents[2] / "docs" / "extending.md"
RATE = 250.0


@dataclass(frozen=True)
class Setting:
    """The shipped planar arm, a noisy recording of it in memory and as a file, and its plain estimate."""

    model: ArmModel
    recording: SampledRecording
    path: Path
    plain: Estimate


@pytest.fixture(scope="module")
def setting(tmp_path_factory: pytest.TempPathFactory) -> Setting:
    model = arm_model(load_arm("planar2"))
    assert model.config.driver is not None
    delta = model.layout.vector(model.config.driver.truth)  # type: ignore[union-attr]
    time, motion, rng = np.arange(4000) / RATE, waves(1, 2), np.random.default_rng(1)
    torque = exact_torque(model, delta, *(motion.derivative(time, order) for order in range(3)))
    torque = torque + rng.normal(size=torque.shape) * np.array([0.1, 0.04])
    position = motion.derivative(time, 0)
    recording = SampledRecording(stamps(len(time), RATE), position, torque, sha256="1" * 64)
    path = tmp_path_factory.mktemp("custom") / "motion.csv"
    rows = np.column_stack([time, position, torque])
    np.savetxt(path, rows, delimiter=",", header="t,q1,q2,tau1,tau2", comments="", fmt="%.10g")
    return Setting(model, recording, path, identify(model, [recording]))


def written(folder: Path, module: str, code: str, function: str = "known") -> Path:
    """A description that names a function, beside its module."""
    (folder / f"{module}.py").write_text(code)
    arm = folder / "arm.yaml"
    arm.write_text(f"extends: planar2\nname: extended\nconstraints:\n  custom: {module}:{function}\n")
    return arm


def function(returned: Callable[[Any, Any], object]) -> CustomFunction:
    return CustomFunction("here:known", "here.py", "0" * 64, returned)


def ident_json(capsys: pytest.CaptureFixture[str], *words: object) -> dict[str, Any]:
    capsys.readouterr()
    code = main([*map(str, words), "--json"])
    document = json.loads(capsys.readouterr().out)
    assert document["exit_code"] == code
    return dict(document)


# The documented example.


@pytest.mark.slow
def test_the_documented_example(setting: Setting, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    block = r"```(?:python|yaml)\n# ([a-z_]+\.(?:yaml|py))[^\n]*\n(.*?)```"
    blocks = re.findall(block, DOCUMENT.read_text(), re.DOTALL)
    assert [name for name, _ in blocks] == ["arm.yaml", "known_bodies.py"]
    for name, text in blocks:
        (tmp_path / name).write_text(text)
    arm, out = tmp_path / "arm.yaml", tmp_path / "result"
    assert main(["identify", str(setting.path), "--arm", str(arm), "--out", str(out), "--second-opinion"]) == 0
    printed = capsys.readouterr().out
    assert "with known_bodies:payload_and_wrist (known_bodies.py) by clarabel: torque error " in printed
    assert "second opinion, scs through cvxpy (optimal): the two agree" in printed
    report = (out / "report.txt").read_text()
    assert "with known_bodies:payload_and_wrist" in report
    assert "second opinion, scs" in report

    document = json.loads((out / "parameters.json").read_text())
    values = dict(zip(document["link_parameters"]["names"], document["link_parameters"]["values"], strict=True))
    assert values["m1"] + values["m2"] == pytest.approx(3.23, abs=1e-6)
    assert [values[name] for name in ("lz2", "Lxz2", "Lyz2")] == pytest.approx([0.0, 0.0, 0.0], abs=1e-6)
    known = document["custom"]
    assert known["sha256"] == hashlib.sha256((tmp_path / "known_bodies.py").read_bytes()).hexdigest()
    without = known["relative_error_percent_without"]
    assert known["relative_error_percent"] >= without * (1.0 - 1e-6) > 0.0  # as exactly as two solvers agree
    assert "They also meet what known_bodies:payload_and_wrist" in (out / "report.html").read_text()
    assert document["feasibility"]["feasible"]
    assert document["feasibility"]["certificate"]["kind"] == "witness"

    # What cannot know of it says so, and proves the rest.
    assert main(["verify", str(out), "--arm", str(arm)]) == 0
    told = capsys.readouterr().out
    assert "proven for planar2_known" in told
    assert "constraints.custom (known_bodies:payload_and_wrist) of the description is code" in told
    assert main(["verify", str(out)]) == 0
    capsys.readouterr()
    tested = ident_json(capsys, "feasible", out / "parameters.json", "--arm", arm)
    assert tested["feasible"]
    assert "left out here" in tested["notes"][0]


def test_the_key_of_the_document_is_one_that_base_prints(setting: Setting) -> None:
    (key,) = re.findall(r"`base\[\"(.+)\"\]`", DOCUMENT.read_text())
    assert key in setting.plain.base.expressions


# Known equivalents.


def test_a_custom_bound_is_the_declared_one(setting: Setting) -> None:
    plain, config = setting.plain, setting.model.config
    tight = Constraints.model_validate({"total_mass": {"upper": 1.0}})
    declared = feasible_set("pseudo_inertia", plain.base.names, config.model_copy(update={"constraints": tight}))
    wanted = constrained_least_squares(plain.fit, plain.base, declared)
    bound = function(lambda link, _: [1.0 - link["m1"] - link["m2"] >= 1e-6])
    found = convex_least_squares(plain.fit, plain.base, plain.conditions, custom=bound).estimate
    free = constrained_least_squares(plain.fit, plain.base, plain.conditions)
    assert wanted.objective > 2.0 * free.objective  # the bound is felt
    assert found.objective == pytest.approx(wanted.objective, rel=1e-6)
    np.testing.assert_allclose(found.beta, wanted.beta, rtol=0, atol=1e-5)
    assert "here:known, constraint 1" in found.tight
    assert found.margin > 0.0


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["euclidean", "entropic"])
def test_a_custom_penalty_counts_as_a_prior_does(setting: Setting, kind: Any) -> None:
    import cvxpy as cp  # loads for a second, which every worker that collects this file would pay

    plain = setting.plain
    assert setting.model.prior is not None
    center = setting.model.prior.copy()
    center[center == 0.0] = 0.0 if kind == "euclidean" else 1e-3
    for link in (0, 1):  # a body for the entropic prior: no products, no moments across the plane
        center[setting.model.layout.inertial(link).start + np.array([1, 2, 4, 7, 8])] = 0.0
    prior = Prior(kind, plain.base.names, center, 30.0)
    wanted = constrained_least_squares(plain.fit, plain.base, plain.conditions, prior)

    def penalty(link: Any, _: Any) -> object:
        delta = cp.hstack([link[name] for name in plain.base.names])
        columns = prior.euclidean
        cost = cp.sum_squares((delta - center)[columns] / prior.scales[columns])
        if kind == "entropic":
            for block in prior.whitened:
                entries = block.F @ delta
                place = {(i, j): k for k, (i, j) in enumerate((i, j) for j in range(4) for i in range(j + 1))}
                rows = [[entries[place[min(i, j), max(i, j)]] for j in range(4)] for i in range(4)]
                cost += cp.trace(cp.bmat(rows)) - cp.log_det(cp.bmat(rows)) - 4.0
        return [], 30.0 * cost

    found = convex_least_squares(plain.fit, plain.base, plain.conditions, custom=function(penalty)).estimate
    assert found.penalty == pytest.approx(30.0 * wanted.prior_distance, rel=1e-4)
    np.testing.assert_allclose(found.beta, wanted.beta, rtol=0, atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("code", [None, "def known(link, base):\n    return []\n"])
def test_replicates_are_drawn_to_the_prior(setting: Setting, tmp_path: Path, code: str | None) -> None:
    arm = "planar2" if code is None else str(written(tmp_path, "pulled", code))
    spread = []
    for weight in (1e-6, 1e6):
        request = Request(arm=arm, recordings=(setting.path,), replicates=3, prior="euclidean", prior_weight=weight)
        identify_files(request, tmp_path / f"{weight:g}")
        drawn = json.loads((tmp_path / f"{weight:g}" / "parameters.json").read_text())["bootstrap"]
        spread.append(max(drawn["standard_deviations"]))
    assert spread[1] < 0.5 * spread[0]  # equal where the prior is not known to them


@pytest.mark.slow
def test_knowledge_about_base_parameters_and_every_replicate(setting: Setting, tmp_path: Path) -> None:
    expression = setting.plain.base.expressions[-3]
    assert expression == "fv2"
    code = f"def known(link, base):\n    return [base[{expression!r}] >= 0.5]\n"
    request = Request(arm=str(written(tmp_path, "replicated", code)), recordings=(setting.path,), replicates=3)
    found = identify_files(request, tmp_path / "out").estimate
    assert setting.plain.beta[-3] < 0.4
    assert found.beta[-3] == pytest.approx(0.5, abs=1e-6)
    drawn = json.loads((tmp_path / "out" / "parameters.json").read_text())["bootstrap"]["standard_deviations"]
    assert drawn[-3] < 1e-6 < drawn[-2]
    without = identify_files(
        Request(arm=str(tmp_path / "arm.yaml"), recordings=(setting.path,), set_name="none"), tmp_path / "without"
    )
    assert without.estimate.custom is None
    np.testing.assert_array_equal(without.estimate.beta, without.estimate.fit.beta)
    # What is not constrained does not know of it, and the description's hash does.
    np.testing.assert_allclose(found.fit.beta, setting.plain.fit.beta, rtol=0, atol=1e-6)
    assert found.model.config.sha256 != load_arm("planar2").sha256


# The second opinion.


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "rel"),
    [
        ((), 1e-6),
        (("--solver", "scs"), 1e-6),
        (("--prior", "entropic", "--prior-weight", "10"), 1e-6),
        (("--feasible-set", "inertia"), 1e-6),
    ],
)
def test_a_second_opinion_agrees(
    setting: Setting, tmp_path: Path, capsys: pytest.CaptureFixture[str], words: tuple[str, ...], rel: float
) -> None:
    arm = tmp_path / "arm.yaml"
    arm.write_text("extends: planar2\nconstraints: {total_mass: {upper: 2}}\n")  # less than it has, so that it is felt
    words = ("--second-opinion", *words, "--out", str(tmp_path / "out"))
    found = ident_json(capsys, "identify", setting.path, "--arm", arm, *words)
    second = found["second_opinion"]
    assert found["exit_code"] == 0
    assert second["agrees"]
    assert second["solvers"] == ["ident", "scs" if "scs" in words else "clarabel"]
    one, other = second["objectives"]
    assert one > 0.1
    assert other == pytest.approx(one, rel=rel)
    assert second["largest_difference_in_deviations"] < 0.05
    assert json.loads((tmp_path / "out" / "parameters.json").read_text())["second_opinion"] == second
    assert "second opinion, " in (tmp_path / "out" / "report.txt").read_text()


def test_a_second_opinion_sees_a_wrong_first_one(setting: Setting) -> None:
    plain = setting.plain
    right = constrained_least_squares(plain.fit, plain.base, plain.conditions)
    wrong = replace(right, beta=right.beta * 1.01, objective=float(np.linalg.norm(plain.fit.R1 @ (right.beta * 1.01))))
    seen = second_opinion(wrong, plain.fit, plain.base, plain.conditions, plain.standard_deviations)
    assert not seen.agrees
    assert seen.torque_percent == pytest.approx(1.0, rel=0.1)
    assert seen.deviations > 1.0
    document = {"base_parameters": {}, "second_opinion": convex_document(replace(plain, second=seen))["second_opinion"]}
    found = assess(document)
    assert found.word == "do not use"
    assert found.reasons[0] == "A second solution of the constrained problem predicts other torques: use neither."
    differing = summary(replace(plain, second=seen))
    assert "THE TWO DIFFER" in differing
    assert differing.startswith("DO NOT USE")
    early = replace(seen, status="optimal_inaccurate")
    assert not early.conclusive
    assert "stopped early; try another --solver" in summary(replace(plain, second=early))


def test_the_wam_agrees_too(wam7: ArmModel) -> None:
    base = base_parameters(wam7.chain, wam7.layout)
    assert wam7.prior is not None
    delta = wam7.prior.copy()
    delta[delta == 0.0] = 0.02
    delta[wam7.layout.inertial(4)] *= -1.0
    conditions = feasible_set("pseudo_inertia", base.names, wam7.config)
    fit = ordinary_least_squares(random_information(wam7, base, delta, noise=0.2))
    first = constrained_least_squares(fit, base, conditions)
    assert first.objective > 0.0
    seen = second_opinion(first, fit, base, conditions, fit.standard_deviations)
    assert seen.agrees
    assert seen.objectives[1] == pytest.approx(seen.objectives[0], rel=1e-5)


# What goes wrong.

WRONG = {
    "not_python": ("def known(:\n", r"importing 'not_python' raised SyntaxError: .*line 1"),
    "raises_early": (
        "x = 1 / 0\n",
        r"importing 'raises_early' raised ZeroDivisionError: .* \(raises_early.py, line 1\)",
    ),
    "exits": ("import sys\nsys.exit(3)\n", r"importing 'exits' raised SystemExit: 3 \(exits.py, line 2\)"),
    "imports_nothing": ("import nonsense_xyz\n", "importing 'imports_nothing' raised ModuleNotFoundError: No module"),
    "other_name": ("def knwon(link, base): return []\n", "the module 'other_name' has no function 'known'"),
    "a_number": ("known = 3\n", "a_number:known is of the type int, not a function"),
    "too_few": ("def known(link): return []\n", "too_few:known raised TypeError: .* takes 1 positional"),
    "asks_wrong": (
        "def known(link, base):\n    return [link['m9'] >= 1]\n",
        r"asks_wrong:known raised KeyError: 'm9' \(asks_wrong.py, line 2\)",
    ),
    "nothing": ("def known(link, base): pass\n", "nothing:known returned None; return a list of cvxpy constraints"),
    "boolean": ("def known(link, base): return [True]\n", "constraint 1 of boolean:known is of the type bool"),
    "one_alone": ("def known(link, base): return link['m1'] >= 1\n", "one_alone:known returned of the type"),
    "not_convex": (
        "import cvxpy as cp\ndef known(link, base): return [link['m1'] >= 1, cp.square(link['lx1']) >= 1]\n",
        r"constraint 2 of not_convex:known is not convex by cvxpy's rules \(DCP\)",
    ),
    "concave": (
        "import cvxpy as cp\ndef known(link, base): return [], cp.sqrt(link['m1'])\n",
        r"the penalty of concave:known is not convex by cvxpy's rules \(DCP\)",
    ),
    "long_penalty": (
        "import cvxpy as cp\ndef known(link, base): return [], cp.hstack([link['m1'], link['m2']])\n",
        r"the penalty of long_penalty:known has the shape \(2,\)",
    ),
    "plain_penalty": (
        "def known(link, base): return [], 3.0\n",
        "the penalty of plain_penalty:known is of the type float",
    ),
    "whole": (
        "import cvxpy as cp\ndef known(link, base): return [link['m1'] == cp.Variable(integer=True)]\n",
        "whole:known uses integer variables",
    ),
    "unset": (
        "import cvxpy as cp\ndef known(link, base): return [link['m1'] <= cp.Parameter()]\n",
        "unset:known uses a cvxpy Parameter",
    ),
    "contradicts": (
        "def known(link, base): return [link['m1'] + link['m2'] >= 5]\n",
        "contradicts:known contradicts the rest of the description",
    ),
}


@pytest.mark.parametrize("module", WRONG)
def test_what_is_wrong_is_stated_in_one_sentence_with_its_place(setting: Setting, tmp_path: Path, module: str) -> None:
    code, words = WRONG[module]
    arm = written(tmp_path, module, code)
    with pytest.raises(ConfigError, match=words) as refused:
        identify_files(Request(arm=str(arm), recordings=(setting.path,)), tmp_path / "out")
    assert str(refused.value).startswith(f"{arm}:4:3: constraints.custom: ")
    assert "\n" not in str(refused.value)
    assert not (tmp_path / "out").exists()


def test_a_module_that_is_not_there(setting: Setting, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arm = tmp_path / "arm.yaml"
    arm.write_text("extends: planar2\nconstraints: {custom: nowhere_xyz.inner:known}\n")
    ended = ident_json(capsys, "identify", setting.path, "--arm", arm, "--out", tmp_path / "out")
    assert ended["exit_code"] == 2
    message = ended["error"]["message"]
    assert "there is no module 'nowhere_xyz.inner'; put nowhere_xyz.py beside the description" in message


def test_a_file_beside_a_description_hides_no_library(tmp_path: Path) -> None:
    (tmp_path / "textwrap.py").write_text("def known(link, base): return []\n")
    with pytest.raises(CustomError, match="the module 'textwrap' has no function 'known'"):
        load_custom("textwrap:known", tmp_path)


@pytest.mark.slow
def test_a_module_on_the_path_and_one_beside_an_extended_description(
    setting: Setting, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for folder, module in (("library", "on_the_path"), ("parent", "beside_the_parent")):
        (tmp_path / folder).mkdir()
        arm = written(tmp_path / folder, module, "def known(link, base): return [link['fv1'] >= 0.6]\n")
        if folder == "library":
            monkeypatch.syspath_prepend(str(tmp_path / folder))
            arm.rename(tmp_path / "arm.yaml")
            arm = tmp_path / "arm.yaml"
        else:
            (tmp_path / "child").mkdir()
            arm = tmp_path / "child" / "arm.yaml"
            arm.write_text("extends: ../parent/arm.yaml\nname: child\n")
        found = identify_files(Request(arm=str(arm), recordings=(setting.path,)), tmp_path / f"{folder}_out").estimate
        assert found.delta is not None
        assert found.delta[found.base.names.index("fv1")] == pytest.approx(0.6, abs=1e-6)


@pytest.mark.parametrize("name", ["custom", "a:b:c", "a b:c", "../a:b", ":f", "m:", "m:f()"])
def test_what_names_no_function_is_refused(tmp_path: Path, name: str) -> None:
    arm = tmp_path / "arm.yaml"
    arm.write_text(f"extends: planar2\nconstraints:\n  custom: '{name}'\n")
    with pytest.raises(ConfigError, match=r"arm.yaml:3:3: constraints.custom: "):
        load_arm(arm)


def test_an_upload_names_no_code(tmp_path: Path) -> None:
    arm = written(tmp_path, "uploaded", "raise SystemExit\n")
    with pytest.raises(ConfigError, match=r":4:3: constraints.custom: a description that is sent names no code"):
        load_arm(arm, upload=True)


def test_the_hash_of_a_description_without_it_stays(tmp_path: Path) -> None:
    config = load_arm("planar2")
    assert '"custom"' not in config.model_dump_json()
    extended = load_arm(written(tmp_path, "hashed", ""))
    (tmp_path / "arm.json").write_text(extended.model_dump_json())
    assert arm_from_json(tmp_path / "arm.json") == extended
    assert extended.constraints.custom == "hashed:known"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--solver", "scs"), "add --second-opinion"),
        (("--solver", "simplex", "--second-opinion"), "the solver 'simplex' is not installed, .*; here are .*clarabel"),
        (("--solver", "osqp", "--second-opinion"), "solves no semidefinite problems"),
        (("--feasible-set", "none", "--second-opinion"), "a second opinion is about the constrained estimate"),
    ],
)
def test_options_that_cannot_be_meant(
    setting: Setting, tmp_path: Path, capsys: pytest.CaptureFixture[str], words: tuple[str, ...], message: str
) -> None:
    ended = ident_json(capsys, "identify", setting.path, "--arm", "planar2", *words, "--out", tmp_path / "out")
    assert ended["exit_code"] == 2
    assert re.search(message, ended["error"]["message"])
    assert not (tmp_path / "out").exists()


def test_a_function_that_is_named_must_be_given(setting: Setting, tmp_path: Path) -> None:
    arm = written(tmp_path, "forgotten", "def known(link, base): return []\n")
    with pytest.raises(UsageError, match=r"names forgotten:known as constraints\.custom; give that function"):
        identify(arm_model(load_arm(arm)), [setting.recording])


def test_what_every_installation_has() -> None:
    assert {"clarabel", "scs"} <= set(available_solvers())
    assert "osqp" not in available_solvers()
