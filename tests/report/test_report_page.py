"""The page's structure: what is in it, in which order, that nothing leaves it and nothing breaks into it."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
from report.conftest import Made, made
from report.pages import Node, parsed, sections
from results.svg import Svg

from ident_service.config.recording import RecordingFormat
from ident_service.config.simulation import SimulatedDriver
from ident_service.results.assessment import assess
from ident_service.results.plots import Axes, Canvas, draw_frame, range_around
from ident_service.results.report.figures import figures, friction_scatter, timing_figures, timing_words
from ident_service.results.report.page import report_html

ORDER = ["verdict", "torque", "parameters", "residual", "friction", "doubt", "bodies", "timing", "files"]


@pytest.mark.slow
def test_sections_come_in_order_under_one_heading_each(good: Made, bare: Made) -> None:
    for page in (good.page, bare.page):
        found = sections(page)
        assert list(found) == ORDER
        assert all(len(node.all("h2")) == 1 for node in found.values())
        # Never blank: every section says or shows something beside its heading.
        assert all(len(node.words) > len(node.one("h2").words) + 20 for node in found.values())
        (document,) = parsed(page).all("html")
        assert document.attributes["lang"] == "en"
        assert len(document.all("h1")) == 1
        assert document.one("title").words == document.one("h1").words == "Identification of random"


def test_every_figure_has_a_sentence_and_a_text_alternative(good: Made) -> None:
    found = parsed(good.page).all("figure")
    # Two joints: torque on two recordings, residual, friction; deviations, correlation; two views; two timings.
    assert len(found) == 4 + 2 + 2 + 2 + 2 + 2
    for figure in found:
        svg = figure.one("div").one("svg")
        assert svg.attributes["role"] == "img"
        assert len(svg.one("title").words) > 5
        assert len(svg.one("desc").words) > 10
        assert len(figure.one("figcaption").words) > 10
    assert len({figure.attributes["id"] for figure in found}) == len(found)


def test_how_to_read_them_is_stated_once_per_section(good: Made) -> None:
    for name, node in sections(good.page).items():
        hints = [p.words for p in node.all("p") if p.attributes.get("class") == "hint"]
        readings = [words for words in hints if re.search(r"\bGood: .+\. Bad: .+\.", words)]
        assert len(readings) == (1 if node.all("figure") else 0), name
        assert not any("Good:" in caption.words for caption in node.all("figcaption"))


def test_rows_and_filter_stand_in_every_section_with_torques(good: Made) -> None:
    for name, which in {
        "torque": "every sample of a recording but",
        "residual": "motion_1.csv",
        "friction": "All rows",
        "doubt": "blocks of about a second",
    }.items():
        (rows,) = [p.words for p in sections(good.page)[name].all("p") if p.attributes.get("class") == "rows"]
        assert which in rows
        assert "a zero-phase Butterworth low-pass of order 3 at 40 Hz. Measured torque: as recorded" in rows


def test_the_top_is_the_assessment(good: Made) -> None:
    found = assess(good.parameters.content)
    top = sections(good.page)["verdict"]
    assert top.one("h2").words == found.line
    assert [item.words for item in top.all("ul")[0].all("li")] == list(found.reasons)
    table = top.one("table")
    rows = [[cell for cell in row.children if isinstance(cell, Node)] for row in table.one("tbody").all("tr")]
    assert [row[0].words for row in rows] == [one.joint for one in found.joints]
    assert [row[1].words for row in rows] == [one.word for one in found.joints]
    assert [float(row[4].one("data").attributes["value"]) for row in rows] == [one.unseen for one in found.joints]
    # All below it is folded but the torques.
    folds = [section.one("details").attributes for section in list(sections(good.page).values())[1:]]
    assert ["open" in attributes for attributes in folds] == [True, *[False] * (len(ORDER) - 2)]


def test_no_two_columns_of_a_table_have_one_name(good: Made) -> None:
    tables = [[cell.words for cell in one.one("thead").all("th")] for one in parsed(good.page).all("table")]
    assert any("fitted, moving [%]" in heads and "unseen, moving [%]" in heads for heads in tables)
    assert [heads for heads in tables if len(set(heads)) < len(heads)] == []


def test_three_rows_and_figures_are_shown_and_the_others_folded(good: Made) -> None:
    table = sections(good.page)["parameters"]
    shown, folded = table.all("table")
    assert len(shown.one("tbody").all("tr")) == 3
    assert len(folded.one("tbody").all("tr")) == good.estimate.base.size - 3
    assert table.all("details")[-1].one("summary").words == f"{good.estimate.base.size - 3} more rows"
    names = tuple(f"j{k}" for k in range(6))
    traced = good.evidence.recordings[0]
    many = replace(traced, joints=tuple(traced.joints[0] for _ in names), spectra=(), spikes=())
    estimates = tuple(replace(one, validation=(), moving_validation=()) for one in good.evidence.estimates)
    evidence = replace(good.evidence, joints=names, revolute=(True,) * 6, recordings=(many,), friction=(), posed=None)
    evidence = replace(evidence, estimates=estimates)
    content = json.loads(json.dumps(good.parameters.content))
    row = content["fit"]["per_joint"][0]
    content["fit"]["per_joint"] = [
        row | {"joint": name, "relative_error_percent": error}
        for name, error in zip(names, (1.0, 9.0, 2.0, 30.0, 3.0, 4.0), strict=True)
    ]
    content["validation"] = []
    found = sections(report_html(evidence, replace(good.parameters, content=content), good.config, {}))["torque"]
    others = found.one("details").all("details")[0]
    assert others.one("summary").words == "3 more joints"
    order = [figure.attributes["id"] for figure in found.all("figure")]
    assert order == [f"torque-1-identification-{k}" for k in (4, 2, 6, 5, 3, 1)]
    assert len(others.all("figure")) == 3


def test_words_of_the_field_stand_on_the_plots(good: Made) -> None:
    drawn = figures(good.evidence, good.parameters)
    name = good.evidence.joints[0]
    for figure in (drawn.torque[0][0], drawn.residual[0], drawn.friction[0]):
        assert name in Svg.of(figure.svg()).words
    assert {"residual", "residual [N m]"} <= set(Svg.of(drawn.torque[0][0].svg()).words)
    assert not re.search(r"less predicted \[|what is left|difference", drawn.torque[0][0].svg())


def test_the_correlation_matrix_has_names_and_all_values(good: Made) -> None:
    figure = next(one for one in figures(good.evidence, good.parameters).doubt if one.slug == "correlation")
    about = figure.data["matrix"]
    size = good.estimate.base.size
    base = good.estimate.base
    assert about["names"] == [base.names[column] for column in base.base]
    words = Svg.of(figure.svg()).words
    assert all(words.count(name) == 2 for name in about["names"])
    hundredths = np.frombuffer(base64.b64decode(about["data"]), np.int8)
    deviations = np.sqrt(np.diag(good.estimate.covariance))
    correlation = good.estimate.covariance / np.outer(deviations, deviations)
    np.testing.assert_allclose(hundredths / 100.0, correlation[np.tril_indices(size, -1)], atol=0.0051)


@pytest.mark.slow
def test_tables_say_what_their_rows_and_columns_are(good: Made, bare: Made) -> None:
    for page in (good.page, bare.page):
        for table in parsed(page).all("table"):
            assert table.one("caption").words
            heads = table.one("thead").all("th")
            assert {head.attributes["scope"] for head in heads} == {"col"}
            for row in table.one("tbody").all("tr"):
                cells = [child for child in row.children if isinstance(child, Node)]
                assert len(cells) == len(heads)
                assert [cell.tag for cell in cells] == ["th"] + ["td"] * (len(heads) - 1)
                assert cells[0].attributes["scope"] == "row"


def test_nothing_leaves_the_page(good: Made) -> None:
    page = good.page
    vendored = files("ident_service").joinpath("vendored/uPlot.iife.min.js").read_text()
    assert vendored in page
    for pattern in (
        r"https?://",
        r"\bsrc\s*=",
        r"@import",
        r"url\(",
        r"<link",
        r"<iframe",
        r"\bon\w+\s*=\s*[\"']",
        "fetch",
    ):
        assert not re.search(pattern, page.replace(vendored, "")), pattern
    # Of the script of others only its address in a comment, and what could load anything is forbidden by the policy.
    assert re.findall(r"https?://\S+", vendored) == ["https://github.com/leeoniya/uPlot"]
    policy = next(
        meta.attributes["content"]
        for meta in parsed(page).all("meta")
        if meta.attributes.get("http-equiv") == "Content-Security-Policy"
    )
    assert policy.startswith("default-src 'none'; ")
    scripts = [script for script in parsed(page).all("script") if "type" not in script.attributes]
    digests = [
        base64.b64encode(hashlib.sha256("".join(map(str, script.children)).encode()).digest()).decode()
        for script in scripts
    ]
    assert len(digests) == 2
    assert f"script-src 'sha256-{digests[0]}' 'sha256-{digests[1]}'; " in policy
    assert "unsafe-eval" not in policy


def parameter_columns(page: str) -> tuple[list[str], list[list[Node]]]:
    """Heads and rows of the parameter table, in the order of the parameters."""
    tables = sections(page)["parameters"].all("table")
    rows = [
        [cell for cell in row.children if isinstance(cell, Node)]
        for table in tables
        for row in table.one("tbody").all("tr")
    ]
    return [head.words for head in tables[0].one("thead").all("th")], sorted(rows, key=lambda row: int(row[0].words))


def numbers(heads: list[str], rows: list[list[Node]], name: str) -> list[float]:
    return [float(row[heads.index(name)].one("data").attributes["value"]) for row in rows]


def test_the_parameter_table_is_the_parameter_file(good: Made) -> None:
    heads, rows = parameter_columns(good.page)
    content = json.loads((good.folder / "parameters.json").read_text())["base_parameters"]
    assert [row[1].words for row in rows] == content["expressions"]
    assert numbers(heads, rows, "FBPE-OLS pseudo_inertia (chosen)") == content["values"]
    assert numbers(heads, rows, "\u03c3") == content["standard_deviations"]
    assert [row[heads.index("verdict")].words for row in rows] == content["verdicts"]
    np.testing.assert_array_equal(numbers(heads, rows, "OLS"), good.estimate.candidates[0].beta)
    np.testing.assert_allclose(numbers(heads, rows, "CAD"), good.estimate.base.K @ (1.1 * good.delta), rtol=1e-12)
    for row in rows:
        cell = row[heads.index("OLS")]
        value = float(cell.one("data").attributes["value"])
        assert float(cell.words.replace("\u2212", "-")) == pytest.approx(value, rel=1e-4)


def test_the_chosen_estimate_is_marked_where_no_set_holds_it(bare: Made) -> None:
    heads, rows = parameter_columns(bare.page)
    content = json.loads((bare.folder / "parameters.json").read_text())["base_parameters"]
    # There are no CAD values, and so no column of them.
    assert heads[3:7] == ["OLS (chosen)", "\u03c3", "verdict", "FBPE-OLS pseudo_inertia"]
    assert numbers(heads, rows, "OLS (chosen)") == content["values"]
    constrained = bare.evidence.estimates[bare.evidence.constrained]
    assert numbers(heads, rows, "FBPE-OLS pseudo_inertia") == constrained.values.tolist()
    # Torques that no body has: the two differ, so that one cannot pass for the other.
    assert np.abs(constrained.values - content["values"]).max() > 1e-2


def test_the_rule_of_the_verdicts_stands_at_the_table(good: Made) -> None:
    words = sections(good.page)["parameters"].words
    assert "below 10 % of the parameter, or changes no joint's torque by more than 1 %" in words
    assert "below 50 % of the parameter, or 5 % of the torque" in words
    assert "widened by Student's t. It is that of the unconstrained fit" in words


def test_a_bound_stands_where_it_binds(good: Made) -> None:
    bounds = tuple(("link 2: a mass distribution exists",) if k == 3 else () for k in range(good.estimate.base.size))
    page = report_html(replace(good.evidence, bounds=bounds), good.parameters, good.config, {})
    heads, rows = parameter_columns(page)
    assert heads[-1] == "bound"
    said = [row[-1].words for row in rows]
    assert said == [bounds[k][0] if k == 3 else "\u2014" for k in range(len(rows))]


def test_what_is_absent_is_stated(bare: Made) -> None:
    found = {name: node.words for name, node in sections(bare.page).items()}
    assert "Not physically feasible: no real body has these parameters" in found["verdict"]
    assert "There is no validation recording" in found["verdict"]
    assert "There is no validation recording" in found["torque"]
    assert "These parameters are not feasible" in found["bodies"]
    assert "no account of its cycles" in found["timing"]


def test_without_friction_or_spectra_that_is_stated(good: Made) -> None:
    recordings = tuple(replace(one, spectra=()) for one in good.evidence.recordings)
    evidence = replace(good.evidence, recordings=recordings, friction=())
    found = {
        name: node.words for name, node in sections(report_html(evidence, good.parameters, good.config, {})).items()
    }
    assert "No recording is long enough for a spectrum." in found["residual"]
    assert "The arm's model has no friction" in found["friction"]


def test_uneven_stamps_are_reported_in_shares_of_a_period(good: Made) -> None:
    first, *others = good.evidence.timing
    worst = 0.35 / first.rate
    uneven = replace(first, largest=worst, edges=np.linspace(0.0, worst, len(first.edges)))
    evidence = replace(good.evidence, timing=(uneven, *others))
    quality = [{"recording": first.recording, "jitter_seconds": {"standard_deviation": 0.0086 / first.rate}}]
    parameters = replace(good.parameters, content=good.parameters.content | {"recording_quality": quality})
    arrival = good.config.model_copy(update={"recording": RecordingFormat(stamps="arrival")})
    for config in (arrival, good.config):
        found = sections(report_html(evidence, parameters, config, {}))
        words = found["timing"].words
        assert "1.4 ms off (35 % of a period); their standard deviation is 0.86 % of a period." in words
        assert "within 5 % (standard deviation; beyond, the warnings name it)" in words
        assert "The period is 4 ms." in words
        assert ("takes stamps for times of arrival" in words) is (config is arrival)
        assert "how far off single steps are stands under Timing" in found["verdict"].words


@pytest.mark.parametrize("size", [1e-3, 0.7, 4.1, 9.0, 39.0, 41.0, 1234.5])
@pytest.mark.parametrize("height", [74.0, 150.0, 200.0])
def test_an_axis_around_zero_has_three_numbers_or_more(size: float, height: float) -> None:
    canvas = Canvas(500.0, 300.0)
    low, high = range_around(np.array([-size, 0.97 * size]))
    draw_frame(canvas, Axes(60.0, 20.0, 400.0, height, 0.0, 1.0, low, high), x="", y="torque [N m]")
    texts = Svg.of(canvas.svg("", "")).all("text", "soft")
    ticks = [float((text.text or "").replace("\u2212", "-")) for text in texts]
    assert len(ticks) >= 3
    assert len(ticks) <= 9
    assert low < min(ticks) < 0.0 < max(ticks) < high


EVIL = "<script>alert(1)</script>\"'&</style>]]>--"


@pytest.mark.slow
def test_names_cannot_break_into_the_page(good: Made) -> None:
    recordings = tuple(replace(one, name=EVIL) for one in good.evidence.recordings)
    evidence = replace(
        good.evidence,
        joints=(EVIL, "b"),
        recordings=recordings,
        timing=tuple(replace(one, recording=EVIL) for one in good.evidence.timing),
        warnings=(EVIL,),
    )
    content = json.loads(json.dumps(good.parameters.content))
    content["base_parameters"]["expressions"][0] = EVIL
    content["provenance"]["software"] = EVIL
    content["feasibility"]["tight"] = [EVIL]
    config = good.config.model_copy(update={"name": EVIL, "description": EVIL})
    page = report_html(evidence, replace(good.parameters, content=content), config, {EVIL: "0" * 64})
    plain = report_html(good.evidence, good.parameters, good.config, {"x": "0" * 64})

    def shape(text: str) -> list[str]:
        document = parsed(text)
        return sorted(f"{tag}" for tag in ("script", "style", "figure", "section", "h1") for _ in document.all(tag))

    assert shape(page) == shape(plain)
    assert "alert(1)" in parsed(page).one("h1").words
    assert "<script>alert" not in page
    for figure in figures(evidence, good.parameters).all():
        Svg.of(figure.svg())


def test_drawings_are_sound_by_themselves(good: Made, bare: Made) -> None:
    for one in (good, bare):
        for figure in figures(one.evidence, one.parameters).all():
            svg = Svg.of(figure.svg())
            svg.require_sound()
            assert (svg.title, svg.description) == (figure.title, figure.description)


def test_a_peak_of_one_sample_is_drawn(good: Made) -> None:
    traced = good.evidence.recordings[0]
    joint = traced.joints[0]
    torque = joint.torque.copy()
    torque[1, 1000] = 10.0 * np.abs(torque).max()
    changed = replace(traced, joints=(replace(joint, torque=torque), *traced.joints[1:]))
    evidence = replace(good.evidence, recordings=(changed, *good.evidence.recordings[1:]))
    svg = Svg.of(figures(evidence, good.parameters).torque[0][0].svg())
    (measured,) = svg.points("polygon", "measured")
    # The frame reaches just beyond the peak, which stands far above everything else.
    top, others = np.sort(measured[:, 1])[0], np.sort(measured[:, 1])[1:]
    assert top < 60.0
    assert others.min() > top + 50.0


def test_recordings_are_in_the_page_for_the_script(good: Made) -> None:
    scripts = {s.attributes["id"]: s for s in parsed(good.page).all("script") if "id" in s.attributes}
    assert sorted(scripts) == ["recording-0", "recording-1"]
    content = json.loads("".join(map(str, scripts["recording-0"].children)))
    assert len(content["joints"]) == 2
    assert set(content["joints"][0]) == {"torque", "predicted", "residual", "standstill"}
    order = [one.place for one in assess(good.parameters.content).joints]
    # What was not fitted to comes first.
    parts = [part for part in parsed(good.page).all("div") if part.attributes.get("class") == "recording"]
    assert [part.attributes["data-recording"] for part in parts] == ["1", "0"]
    for part in parts:
        series = [json.loads(figure.attributes["data-series"]) for figure in part.all("figure")]
        assert [one["joint"] for one in series] == order
        assert [(one["name"], one["unit"]) for one in series] == [(good.evidence.joints[k], "N m") for k in order]


def test_hashes_of_what_was_used_are_named(good: Made) -> None:
    words = sections(good.page)["files"].words
    manifest = json.loads((good.folder / "manifest.json").read_text())["files"]
    for digest in (good.evidence.recordings[0].sha256, manifest["parameters.json"], manifest["evidence.json"]):
        assert digest in words


def test_warnings_are_listed(tmp_path: Path) -> None:
    one = made(tmp_path / "results", warnings=("motion_1.csv: stamps jitter", "motion_1.csv: torn"))
    top = sections(one.page)["verdict"]
    assert {*one.evidence.warnings} <= {item.words for item in top.all("li")}
    assert "correct what the warnings name" in top.words


@pytest.mark.parametrize(
    ("described", "recorded", "words"),
    [
        (True, "simulated", "The arm is simulated: this is no commissioning of a real arm."),
        (False, "simulated", "The arm is simulated: this is no commissioning of a real arm."),
        (True, "canopen", ""),  # formerly no commissioning, either
        (True, "", "The description is of a simulated arm; its recordings do not say which arm they are of."),
        (False, "", ""),
        (False, "canopen", ""),
    ],
)
def test_a_simulated_arm_cannot_pass_for_a_real_one_nor_a_real_one_for_it(
    described: bool, recorded: str, words: str, good: Made
) -> None:
    driver = SimulatedDriver(kind="simulated") if described else good.config.driver
    recordings = tuple(replace(one, driver=recorded) for one in good.evidence.recordings)
    config = good.config.model_copy(update={"driver": driver})
    page = report_html(replace(good.evidence, recordings=recordings), good.parameters, config, {})
    header = parsed(page).one("header").words
    assert words in header
    assert ("simulated" in header) is bool(words)


def test_the_friction_s_shape_is_in_its_section(good: Made) -> None:
    content = json.loads(json.dumps(good.parameters.content))
    content["friction"] = {"presliding": [0.0125, 0.0], "stribeck_velocity": [0.25, 0.031]}
    table = sections(report_html(good.evidence, replace(good.parameters, content=content), good.config, {}))["friction"]
    rows = [[child.words for child in row.children if isinstance(child, Node)] for row in table.all("tr")]
    order = [one.place for one in assess(good.parameters.content).joints]
    assert rows[0] == [
        "joint",
        "off the curve, rms",
        "pre-sliding distance",
        "Stribeck velocity",
        "parameters of the curve",
    ]
    shape = {0: ["0.0125 rad", "0.25 rad/s"], 1: ["0 rad", "0.031 rad/s"]}
    for row, k in zip(rows[1:], order, strict=True):
        assert row[0] == f"joint_{k}"
        assert row[1] == f"{friction_scatter(good.evidence, k):.3g} N m"
        assert row[2:4] == shape[k]
        assert row[4] == ", ".join(good.evidence.friction[k].terms)
    # A model with neither has no columns of them.
    heads = [head.words for head in sections(good.page)["friction"].one("thead").all("th")]
    assert heads == ["joint", "off the curve, rms", "parameters of the curve"]


def test_the_page_is_small(good: Made) -> None:
    # Two short recordings of two joints; the WAM's size is held by the slow tests.
    assert len(good.page.encode()) < 1e6


def test_recordings_of_one_name_have_their_own_timing(good: Made) -> None:
    first = replace(good.evidence.timing[0], recording="motion.csv")
    evidence = replace(good.evidence, timing=(first, first))
    quality = [{"recording": "motion.csv", "jitter_seconds": {"standard_deviation": one}} for one in (1e-6, 9e-5)]
    parameters = replace(good.parameters, content={**good.parameters.content, "recording_quality": quality})
    one, other = (figure.description for figure in timing_figures(evidence, parameters))
    assert (one, other) == (timing_words(first, 1e-6), timing_words(first, 9e-5))
    assert one != other
