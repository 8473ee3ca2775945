"""The arm in three dimensions, in a browser that draws by software, and in one without WebGL."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from daemon.conftest import commissioned as commissioned
from daemon.conftest import quick_text
from helpers.meshes import threelink
from page.conftest import Reached, listening, log_in
from playwright.sync_api import Browser, ConsoleMessage, Page, expect

from ident_service.operations.description_process import _drawn_document
from ident_service.operations.run_archive import import_run
from ident_service.registry.arms import add_arm

pytestmark = pytest.mark.slow
ARM = "quick"
NO_WEBGL = """
const asked = HTMLCanvasElement.prototype.getContext;
HTMLCanvasElement.prototype.getContext = function (kind, ...rest) {
  return kind.startsWith("webgl") ? null : asked.call(this, kind, ...rest);
};
"""
PIXELS = """
async () => {
  const canvas = document.getElementById("viewer-canvas");
  canvas.dispatchEvent(new KeyboardEvent("keydown", { key: "+" })); // draws; the frame lasts as long as this task
  const shot = await createImageBitmap(canvas);
  const flat = new OffscreenCanvas(shot.width, shot.height).getContext("2d");
  flat.drawImage(shot, 0, 0);
  const { data } = flat.getImageData(0, 0, shot.width, shot.height);
  const seen = new Set();
  const colour = (k) => (data[k] << 16) | (data[k + 1] << 8) | data[k + 2];
  for (let k = 0; k < data.length; k += 4) if (data[k + 3]) seen.add(colour(k));
  return seen.size;
}
"""


COUNTED = """
window.drawings = 0;
const clear = WebGL2RenderingContext.prototype.clear;
WebGL2RenderingContext.prototype.clear = function (...given) {
  window.drawings += 1;
  return clear.apply(this, given);
};
"""
LOOK = """() => {
  const canvas = document.getElementById("viewer-canvas");
  for (const key of ["ArrowLeft", "ArrowRight"]) canvas.dispatchEvent(new KeyboardEvent("keydown", { key }));
  return canvas.toDataURL();
}"""


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory, commissioned: Path) -> Iterator[tuple[Reached, str]]:
    """A service with an arm, and a run of it."""
    state = tmp_path_factory.mktemp("viewer") / "state"
    with listening(state) as reached:
        add_arm(reached.service.db, state, quick_text(ARM), {}, "test", replace=True)
        import_run(reached.service.db, state, commissioned, "test")
        yield reached, commissioned.name


@pytest.fixture
def page(browser: Browser, shown: tuple[Reached, str]) -> Iterator[Page]:
    """A page of an operator on which nothing may be complained of."""
    reached, _ = shown
    page = log_in(browser, reached)
    said = list[str]()

    def hear(message: ConsoleMessage) -> None:
        # Chromium warns of its own slowness when pixels are read, and names the answers that tests refuse.
        if message.type in ("error", "warning") and not any(one in message.text for one in ("GPU stall", "409", "404")):
            said.append(message.text)

    page.on("console", hear)
    page.on("pageerror", lambda error: said.append(str(error)))
    yield page
    page.context.close()
    assert said == []


def drawn(page: Page) -> int:
    """Draw once more and count the colours."""
    return int(page.evaluate(PIXELS))


def confirm_page(page: Page, reached: Reached, kind: str = "run", arm: str = ARM) -> None:
    """Ask for a motion as the page of the arm does, whichever of its steps comes next."""
    page.goto(f"{reached.url}/arms/{arm}")
    with page.expect_navigation():
        page.evaluate(
            """([address, kind]) => {
              const form = document.createElement("form");
              Object.assign(form, { method: "post", action: address });
              form.innerHTML = `<input name="kind" value="${kind}"><input name="speed" value="1">`;
              document.body.append(form);
              form.submit();
            }""",
            [f"/arms/{arm}/confirm", kind],
        )
    page.get_by_label("Type the arm's name").wait_for()


def test_a_motion_is_seen_before_it_is_made(shown: tuple[Reached, str], page: Page) -> None:
    reached, _ = shown
    confirm_page(page, reached)
    page.locator("#viewer-controls").wait_for()
    expect(page.get_by_label("Type the arm's name")).to_be_focused()  # the viewer takes nothing from the question
    assert drawn(page) > 50
    picture, slider = (page.locator(f"#viewer-{name}").bounding_box() for name in ("canvas", "controls"))
    assert picture is not None
    assert slider is not None
    assert picture["width"] == pytest.approx(slider["width"], abs=2)  # as wide as the page lets it be
    assert picture["height"] > 300
    view = page.evaluate(f"fetch('/api/v1/arms/{ARM}/view?motion=own').then((answer) => answer.json())")
    end, near = view["time"][-1], view["clearance"]["itself"]["distance"]
    at = page.locator("#viewer-at")
    expect(at).to_have_text(f"0.00 s of {end:.2f} s, approach")
    expect(page.locator("#viewer-itself-least")).to_contain_text(f"{1000 * min(near):.0f} mm at ")
    expect(page.locator("#viewer-itself")).to_contain_text(f"{1000 * near[0]:.0f} mm, ")
    # The slider by keyboard, to the end.
    page.locator("#viewer-time").press("End")
    expect(at).to_have_text(f"{end:.2f} s of {end:.2f} s, return")
    expect(page.locator("#viewer-itself")).to_contain_text(f"{1000 * near[-1]:.0f} mm, ")
    play = page.get_by_role("button", name="Play")
    play.click()  # from the beginning again
    page.get_by_role("button", name="Pause").click()
    now = float(at.inner_text().split()[0])
    assert 0.0 < now < end
    expect(play).to_have_attribute("aria-pressed", "false")
    # The nearest pair of bodies has a colour of its own.
    page.locator("#viewer-canvas").press("ArrowLeft")
    assert drawn(page) > 50


def test_a_run_is_seen_as_it_was_measured(shown: tuple[Reached, str], page: Page) -> None:
    reached, run = shown
    page.goto(f"{reached.url}/runs/{run}")
    page.locator("#viewer-controls").wait_for()
    assert drawn(page) > 50
    view = page.evaluate(f"fetch('/api/v1/runs/{run}/view').then((answer) => answer.json())")
    expect(page.locator("#viewer-at")).to_have_text(f"0.00 s of {view['time'][-1]:.2f} s")
    path = page.locator("#viewer-clearance .itself").get_attribute("d")
    assert path is not None
    assert path.count("L") == len(view["clearance"]["samples"]) - 1


def test_distances_are_reported_while_the_arm_moves(shown: tuple[Reached, str], page: Page) -> None:
    reached, _ = shown
    page.add_init_script(COUNTED)
    confirm_page(page, reached, "rehearse")
    page.locator("#viewer-controls").wait_for()
    view = page.evaluate(f"fetch('/api/v1/arms/{ARM}/view?motion=own').then((answer) => answer.json())")
    near, samples = view["clearance"]["itself"], view["clearance"]["samples"]
    row = int(np.argmin(near["distance"]))
    posture = [values[samples[row]] for values in view["position"]]
    tell = """([joints, posture]) => document.dispatchEvent(new CustomEvent("samples", { detail: {
      joints, time: [1.5], position: posture.map((value) => [0, value]) } }))"""
    joints = [joint["name"] for joint in view["figure"]["joints"]]
    page.evaluate(tell, [joints, posture])
    expect(page.locator("#viewer-status")).to_have_text("As measured, 1.5 s after the beginning.")
    pair = view["clearance"]["pairs"][near["pair"][row]]
    expect(page.locator("#viewer-itself")).to_have_text(f"{1000 * near['distance'][row]:.0f} mm, {pair}")
    expect(page.locator("#viewer-distances")).to_be_visible()
    # Samples that come faster than a picture is on the screen are not drawn one by one: plots beside it need the time.
    drawings = page.evaluate(
        f"([joints, posture]) => {{ const tell = {tell}; window.drawings = 0;"
        " for (let k = 0; k < 50; k += 1) tell([joints, posture]); return window.drawings; }",
        [joints, posture],
    )
    assert drawings <= 1
    # Away from the motion nobody has computed them.
    page.evaluate(tell, [joints, [value + 3.0 for value in posture]])
    expect(page.locator("#viewer-distances")).to_be_hidden()


def test_the_browser_places_joints_as_the_service_does(shown: tuple[Reached, str], page: Page) -> None:
    """The pictures' kinematics against those that identification uses, on the arm with the most joints."""
    from ident_service.config.load import load_arm
    from ident_service.model.arm_model import arm_model
    from ident_service.model.kinematics import joint_frames

    reached, _ = shown
    model = arm_model(load_arm("wam7_sim"))
    confirm_page(page, reached)
    page.evaluate("document.getElementById('viewer').dataset.source = '/api/v1/arms/wam7_sim/view?motion=own'")
    source = page.evaluate("[...document.scripts].find((one) => one.src.endsWith('viewer.js')).src")
    text = page.evaluate(f"fetch('{source}').then((answer) => answer.text())")
    body = text.replace("./three.module.min.js", source.replace("viewer.js", "three.module.min.js"))
    assert "export" not in body
    # The same script as a module that hands out its class.
    page.route(
        "**/placed.js", lambda route: route.fulfill(body=f"{body}\nexport {{ Arm }};", content_type="text/javascript")
    )
    position = np.linspace(-0.7, 0.9, 7).tolist()
    found = page.evaluate(
        """async ([address, position]) => {
          const { Arm } = await import(address);
          const view = await (await fetch(document.getElementById("viewer").dataset.source)).json();
          const arm = new Arm(view.figure);
          arm.pose(position);
          return arm.joints.map((joint) => joint.frame.matrixWorld.toArray());
        }""",
        [source.replace("viewer.js", "placed.js"), position],
    )
    turns, places = joint_frames(model.chain, np.array([position]))
    for k, entries in enumerate(found):
        matrix = np.array(entries).reshape(4, 4).T
        np.testing.assert_allclose(matrix[:3, :3], turns[0, k], atol=1e-4)
        np.testing.assert_allclose(matrix[:3, 3], places[0, k], atol=1e-4)


def test_meshes_cover_the_capsules_that_distances_are_of(
    shown: tuple[Reached, str], page: Page, tmp_path: Path
) -> None:
    reached, _ = shown
    text, urdf, meshes = threelink("crane")
    for name, content in meshes.items():
        (tmp_path / name).write_bytes(content)
    add_arm(
        *(reached.service.db, reached.service.state, text, {"threelink.urdf": urdf}, "test"),
        make_meshes=lambda path, out: _drawn_document(path, tmp_path, out),
    )
    confirm_page(page, reached, arm="crane")
    box = page.get_by_label("Show what distances are of")
    expect(page.locator("#viewer-status")).to_contain_text("link 'base' has parts without a mesh; capsules are shown")
    expect(box).not_to_be_checked()
    looks = []
    for wanted in (False, True, False):
        box.set_checked(wanted)
        looks.append(page.evaluate(LOOK))
    assert looks[0] == looks[2] != looks[1]
    # An arm without meshes does not offer them; one whose meshes do not come keeps its capsules.
    page.route("**/meshes/**", lambda route: route.fulfill(status=404, json={}))
    confirm_page(page, reached, arm="crane")
    expect(page.locator("#viewer-status")).to_contain_text("base")
    assert page.evaluate(LOOK) == looks[1]
    expect(box).to_be_hidden()


def test_without_webgl_times_and_distances_stay(shown: tuple[Reached, str], page: Page) -> None:
    reached, _ = shown
    page.add_init_script(NO_WEBGL)
    confirm_page(page, reached)
    page.locator("#viewer-controls").wait_for()
    expect(page.locator("#viewer-missing")).to_contain_text("has no WebGL")
    expect(page.locator("#viewer-canvas")).to_be_hidden()
    page.locator("#viewer-time").press("End")
    expect(page.locator("#viewer-at")).to_contain_text("return")
    expect(page.locator("#viewer-itself")).to_contain_text(" mm, ")


def test_what_cannot_be_shown_is_stated(shown: tuple[Reached, str], page: Page) -> None:
    reached, _ = shown
    page.route("**/view?motion=own*", lambda route: route.fulfill(status=409, json={"error": {"message": "no limits"}}))
    confirm_page(page, reached)
    expect(page.locator("#viewer-status")).to_have_text("The arm cannot be shown: no limits")
    expect(page.locator("#viewer-controls")).to_be_hidden()
