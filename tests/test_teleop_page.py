"""The teleoperation page in a real browser against the real server process."""

from __future__ import annotations

import signal
import threading
import time

import numpy as np
import pytest
from browser import browsing
from teleop_sessions import driving, push

from lerobot_roborecover.build.teleop.client import Client
from lerobot_roborecover.build.teleop.store import read_recording
from lerobot_roborecover.build.teleop.takeover import Takeover
from lerobot_roborecover.build.teleop.write import recordings_folder
from lerobot_roborecover.env.options import OptionError

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
    deadline = time.monotonic() + 60
    while step(page) < wanted:
        assert time.monotonic() < deadline, f"step {step(page)}, not {wanted}"
        time.sleep(0.02)


def hold(page, code: str, until: int) -> None:
    """Holds a key until that step."""
    page.keyboard.down(code)
    reach(page, until)
    page.keyboard.up(code)


def still(page) -> int:
    """The step, once it does not change any more."""
    seen = -1
    while seen != (seen := step(page)):
        time.sleep(0.15)
    return seen


def recordings(out):
    return [read_recording(p) for p in sorted(recordings_folder(out).glob("recording-*.npz"))]


def test_a_person_drives_marks_reloads_and_saves_and_a_killed_server_loses_nothing_saved(visit, out):
    with driving(out, *STARTS) as (_process, address):
        page, said = visit(address)
        assert "token" not in page.url
        page.wait_for_selector('body[data-link="up"][data-role="drive"]')
        page.keyboard.press("Enter")
        page.wait_for_selector('body[data-under="way"]')
        page.wait_for_selector('#cameras canvas[data-step="0"]')
        assert page.inner_text("#about").endswith("seed 3 (1 of 3)")
        hold(page, "KeyA", 4)
        before = still(page)
        # Time stands still while nothing is held; a tap is a step.
        time.sleep(0.5)
        assert step(page) == before
        page.keyboard.press("KeyW")
        reach(page, before + 1)
        taps = still(page)
        assert taps <= before + 3
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
        # Somebody else takes the wheel; the page watches, and takes it back.
        with Client(address) as client:
            page.wait_for_selector('body[data-role="watch"]')
            page.keyboard.press("KeyM")
            page.wait_for_selector("#message:has-text('somebody else drives')")
            client.look()
            push(client)
            page.wait_for_selector('body[data-solved="yes"]')
            page.keyboard.press("KeyV")
            page.wait_for_selector('body[data-role="drive"]')
        page.keyboard.press("Enter")
        page.wait_for_selector('body[data-saved="ann-push-left-s3-000001"]')
        page.wait_for_selector("#about:has-text('seed 4 (2 of 3)')")
        hold(page, "KeyS", 3)
        port = int(address.split(":")[2].split("/")[0])
        assert said == []
    (saved,) = recordings(out)
    assert saved.mark == (taps, "Contact", "Wrong Pose")
    assert not saved.lacks
    assert saved.solved[-1]
    assert (saved.actions[:4] == [-0.5, 0.0]).all(), "left at half speed, exactly"
    assert saved.notes["steps_undone"] == 10
    # Started again on the same port, the page is back by itself; what was saved is there.
    with driving(out, *STARTS, port=port):
        page.wait_for_selector('body[data-link="up"]')
        page.wait_for_selector('body[data-saved_count="1"]:not([data-under="way"])')
        page.keyboard.press("Enter")
        page.wait_for_selector('body[data-under="way"]')
        hold(page, "KeyW", 2)
        still(page)
        page.keyboard.press("Backspace")
        page.wait_for_selector("#message:has-text('press again')")
        page.keyboard.press("Backspace")
        page.wait_for_selector('body:not([data-under="way"])')
    assert len(recordings(out)) == 1


PAD = """() => {
  const pad = { connected: true, axes: [0, 0, 0, 0],
    buttons: Array.from({ length: 16 }, () => ({ pressed: false, value: 0 })) };
  window.pad = pad;
  navigator.getGamepads = () => [pad];
}"""


def test_a_gamepad_drives(visit, out):
    with driving(out, *STARTS, "--rate=10") as (_process, address):
        page, said = visit(address)
        page.wait_for_selector('body[data-link="up"]')
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
