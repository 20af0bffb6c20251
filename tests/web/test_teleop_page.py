"""The teleoperation page in a real browser against the real server process."""

from __future__ import annotations

import signal
import threading
import time

import numpy as np
import pytest

from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.web.teleop.client import Client
from lerobot_roborecover.web.teleop.store import read_recording
from lerobot_roborecover.web.teleop.takeover import Takeover
from lerobot_roborecover.web.teleop.write import recordings_folder
from tests.support.browser import browsing
from tests.support.processes import PATIENCE_S
from tests.support.teleop_sessions import driving, push

pytestmark = pytest.mark.browser

STARTS = ("--task=push-left", "--seeds=3-5")


@pytest.fixture(scope="module")
def visit():
    with browsing() as visit:
        yield visit


@pytest.fixture
def out(tmp_path):
    return tmp_path / "set"


def step(page) -> int:
    return int(page.get_attribute("body", "data-step") or 0)


def reach(page, wanted: int) -> None:
    """Waits for a step. (The page's own rules forbid Playwright's `wait_for_function`.)"""
    deadline = time.monotonic() + PATIENCE_S
    while step(page) < wanted:
        assert time.monotonic() < deadline, f"step {step(page)}, not {wanted}"
        time.sleep(0.02)


def hold(page, code: str, until: int) -> None:
    """Holds a key until that step."""
    page.keyboard.down(code)
    reach(page, until)
    page.keyboard.up(code)


def tap(page, code: str) -> None:
    """Presses and releases a key within one task of the page, which no busy machine makes longer."""
    page.evaluate(
        "code => ['keydown', 'keyup'].forEach("
        "type => document.body.dispatchEvent(new KeyboardEvent(type, {code, bubbles: true})))",
        code,
    )


def still(page) -> int:
    """The step, once it does not change any more."""
    seen = -1
    while seen != (seen := step(page)):
        time.sleep(0.15)
    return seen


def begin(page) -> None:
    """From the preview into driving."""
    page.wait_for_selector('body[data-phase="preview"]')
    page.keyboard.press("Enter")
    page.wait_for_selector('body[data-under="way"]')


def recordings(out):
    return [read_recording(p) for p in sorted(recordings_folder(out).glob("recording-*.npz"))]


def test_a_person_drives_marks_reloads_and_saves_and_a_killed_server_loses_nothing_saved(visit, out):
    with driving(out, *STARTS) as (_process, address):
        page, said = visit(address)
        assert "token" not in page.url
        page.wait_for_selector('body[data-link="up"][data-role="drive"]')
        # The start is shown before anything counts.
        page.wait_for_selector('body[data-phase="preview"]:not([data-under="way"])')
        page.wait_for_selector('#cameras canvas[data-step="0"]')
        assert page.inner_text("#advice").startswith("This is the start: Enter begins")
        page.keyboard.press("KeyW")
        page.wait_for_selector("#message:has-text('press Enter to begin')")
        begin(page)
        assert page.inner_text("#about").endswith("seed 3 (1 of 3)")
        hold(page, "KeyA", 4)
        before = still(page)
        # Time stands still while nothing is held; a tap is a step.
        time.sleep(0.5)
        assert step(page) == before
        tap(page, "KeyW")
        reach(page, before + 1)
        taps = still(page)
        assert taps == before + 1
        page.keyboard.press("Digit2")
        page.keyboard.press("KeyM")
        page.wait_for_selector(f'body[data-mark="{taps}"]')
        page.keyboard.press("Digit6")
        hold(page, "KeyD", taps + 12)
        after = still(page)
        page.keyboard.press("KeyZ")
        page.wait_for_selector(f'body[data-step="{after - 10}"]')
        page.wait_for_selector(f'#cameras canvas[data-step="{after - 10}"]')
        assert "not solved after the mark" not in page.inner_text("#message")
        page.keyboard.press("Enter")
        page.wait_for_selector("#message:has-text('not solved after the mark. Enter again keeps it')")
        # The recording lives with the simulator.
        page.reload()
        page.wait_for_selector(f'body[data-step="{after - 10}"][data-mark="{taps}"][data-role="drive"]')
        assert "Contact · Wrong Pose" in page.inner_text("#marked")
        # Another page takes control; this page watches, and takes control back.
        with Client(address) as client:
            page.wait_for_selector('body[data-role="watch"]')
            page.keyboard.press("KeyM")
            page.wait_for_selector("#message:has-text('another page drives')")
            client.look()
            push(client)
            page.wait_for_selector('body[data-solved="yes"]')
            page.keyboard.press("KeyV")
            page.wait_for_selector('body[data-role="drive"]')
        page.keyboard.press("Enter")
        page.wait_for_selector('body[data-saved="ann-push-left-s3-000001"]')
        page.wait_for_selector("#about:has-text('seed 4 (2 of 3)')")
        assert page.inner_text("#message") == "ann-push-left-s3-000001 is saved"
        assert page.locator("#labels button[aria-pressed=true]").count() == 0, "labels are of one recording"
        begin(page)
        hold(page, "KeyS", 3)
        port = int(address.split(":")[2].split("/")[0])
        assert said == []
    (saved,) = recordings(out)
    assert saved.mark == (taps, "Contact", "Wrong Pose")
    assert not saved.lacks
    assert saved.solved[-1]
    assert (saved.actions[:4] == [-0.5, 0.0]).all(), "left at half speed, exactly"
    assert saved.notes["steps_undone"] == 10
    # Started again on the same port, the page is back by itself; what was saved is there, and what comes
    # next is what was not saved.
    with driving(out, *STARTS, port=port):
        page.wait_for_selector('body[data-link="up"]')
        page.wait_for_selector('body[data-saved_count="1"]:not([data-under="way"])')
        page.wait_for_selector("#about:has-text('seed 4 (2 of 3)')")
        begin(page)
        hold(page, "KeyW", 2)
        still(page)
        page.keyboard.press("Backspace")
        page.wait_for_selector("#message:has-text('Backspace again discards them')")
        page.keyboard.press("Backspace")
        # What was discarded is tried again; N goes on.
        begin(page)
        assert page.inner_text("#about").endswith("seed 4 (2 of 3)")
        page.keyboard.press("KeyN")
        page.wait_for_selector('body[data-phase="preview"] #about:has-text("seed 5 (3 of 3)")')
    assert len(recordings(out)) == 1


@pytest.mark.nightly
def test_answers_stand_beside_the_picture_and_buttons_work_without_a_mouse(visit, out):
    with driving(out, "--task=push-left") as (_process, address):
        page, said = visit(address)
        begin(page)
        for width, height in ((1024, 700), (1400, 900), (390, 800)):
            page.set_viewport_size({"width": width, "height": height})
            page.keyboard.press("Enter")  # nothing was driven, nothing is marked: refused
            page.wait_for_selector("#message:has-text('no recovery point marked')")
            for name in ("#message", "#advice", "#cameras canvas"):
                box = page.locator(name).bounding_box()
                assert 0 <= box["y"] <= box["y"] + box["height"] <= height, (name, width)
                assert 0 <= box["x"] <= box["x"] + box["width"] <= width, (name, width)
            assert page.evaluate("() => document.documentElement.scrollWidth") <= width
            page.keyboard.press("Enter")  # insists; there is nothing to keep all the same
            page.wait_for_selector("#message:has-text('nothing was driven yet')")
        page.keyboard.press("KeyW")
        reach(page, 1)
        before = still(page)
        page.focus("button[data-code='KeyM']")
        page.keyboard.press("Enter")
        page.wait_for_selector(f'body[data-mark="{before}"]')
        page.keyboard.press("Tab")
        page.keyboard.press("Space")  # Back, not the gripper that this robot lacks
        page.wait_for_selector('body[data-step="0"][data-mark=""]')
        assert "gripper" not in page.inner_text("#message")
        page.keyboard.press("KeyW")  # the keys are the robot's again
        reach(page, 1)
        assert page.evaluate("() => document.activeElement === document.body")
        assert said == []


@pytest.mark.nightly
def test_a_second_page_watches_at_once_and_takes_the_wheel(visit, out):
    with driving(out, "--task=push-left") as (_process, address):
        first, _ = visit(address)
        begin(first)
        second, said = visit(address)
        second.wait_for_selector('body[data-role="watch"][data-under="way"]')
        second.wait_for_selector('#cameras canvas[data-step="0"]')
        assert "another page drives" in second.inner_text("#advice")
        second.keyboard.press("Enter")
        second.wait_for_selector("#message:has-text('V takes control')")
        first.close()
        second.wait_for_selector("#advice:has-text('no page drives')")
        second.click("#wheel")
        second.wait_for_selector('body[data-role="drive"]')
        hold(second, "KeyA", 2)
        assert said == []


@pytest.mark.nightly
def test_a_wrong_address_gets_a_page_for_people(visit, out):
    with driving(out, "--task=push-left") as (_process, address):
        origin = address.split("/drive")[0]
        for url in (f"{origin}/", f"{origin}/drive/", f"{origin}/drive/?token=wrong"):
            page, _ = visit(url)
            assert "needs its token" in page.inner_text("h1")
            assert "roborecover curate teleop" in page.inner_text("body")
        assert "no such page" in visit(f"{origin}/elsewhere")[0].inner_text("body")
        page, _ = visit(address)
        page.goto(f"{origin}/")
        page.wait_for_selector('body[data-link="up"]')


PAD = """() => {
  const pad = { connected: true, axes: [0, 0, 0, 0],
    buttons: Array.from({ length: 16 }, () => ({ pressed: false, value: 0 })) };
  window.pad = pad;
  navigator.getGamepads = () => [pad];
}"""


@pytest.mark.nightly
def test_a_gamepad_drives(visit, out):
    with driving(out, *STARTS, "--rate=10") as (_process, address):
        page, said = visit(address)
        page.wait_for_selector('body[data-phase="preview"]')
        page.evaluate(PAD)
        press = (
            "n => { pad.buttons[n].pressed = true; setTimeout(() => delete pad.buttons[n].pressed, 120); }"
        )
        page.evaluate(press, 9)
        page.wait_for_selector('body[data-under="way"]')
        page.evaluate("() => { pad.axes = [0.575, -1, 0, 0.1]; }")
        reach(page, 5)
        page.evaluate("() => { pad.axes = [0.1, 0, 0, 0]; }")
        driven = still(page)
        page.evaluate(press, 2)
        page.wait_for_selector(f'body[data-mark="{driven}"]')
        page.keyboard.press("Enter")
        page.wait_for_selector("#message:has-text('Enter again')")
        page.keyboard.press("Enter")
        page.wait_for_selector("body[data-saved]")
        assert said == []
    (saved,) = recordings(out)
    assert saved.lacks == "not solved after the mark"
    assert saved.notes["devices"] == {"gamepad": driven}
    assert np.allclose(saved.actions, [0.25, 0.5])


def test_a_person_takes_over_at_the_page(visit, tmp_path, monkeypatch):
    torch = pytest.importorskip("torch")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    driver = Takeover(0)
    page, said = visit(driver.address)
    page.wait_for_selector("#instruction:has-text('Waiting for a policy')")
    page.keyboard.press("KeyH")
    page.wait_for_selector("#message:has-text('no policy has handed over yet')")
    seen = {
        "observation.state": torch.zeros(4),
        "observation.environment_state": torch.zeros(6),
        "observation.images.top": torch.rand(3, 24, 32),
    }
    actions, slot = [], driver.take("push the puck")

    def evaluation() -> None:
        while (action := driver.act(slot, seen)) is not None:
            actions.append(action)
        driver.leave(slot)

    waiting = threading.Thread(target=evaluation, daemon=True)
    waiting.start()
    page.wait_for_selector('body[data-under="way"][data-mode="takeover"]')
    page.wait_for_selector('#cameras canvas[data-camera="observation.images.top"]')
    assert page.inner_text("#instruction") == "push the puck"
    assert page.is_hidden("#save")
    with pytest.raises(OptionError, match="one simulator at a time"):
        driver.take("another")
    hold(page, "KeyW", 3)
    driven = still(page)
    page.keyboard.press("KeyH")
    page.wait_for_selector('body:not([data-under="way"])')
    waiting.join(10)
    assert not waiting.is_alive()
    assert len(actions) == driven
    assert np.allclose(actions, [0.0, 0.5])
    assert actions[0].dtype == np.float32
    assert said == []


def test_interrupting_the_command_ends_it(out):
    with driving(out, *STARTS, end=signal.SIGINT) as (process, _address):
        pass
    assert process.returncode == 0
