"""The console on a phone: let in by a code, one at a time, and what is pressed there reaches the run."""

from __future__ import annotations

import shutil
import ssl
import subprocess
import threading

import httpx
import numpy as np
import pytest

from lerobot_roborecover.robot.console import Console
from lerobot_roborecover.robot.phone.server import Phone, PhoneConfig
from lerobot_roborecover.scenario import ScenarioError
from tests.support.browser import browsing


@pytest.fixture
def served(monkeypatch):
    monkeypatch.setattr("lerobot_roborecover.robot.phone.server._LAST_LOOK_S", 0.0)
    console, lines = Console(), []
    phone = Phone(console, PhoneConfig(port=0), lines.append)
    yield console, phone, lines
    phone.close()


def client(phone: Phone) -> httpx.Client:
    return httpx.Client(base_url=phone.address)


def test_a_phone_needs_the_code_and_a_second_one_takes_over(served):
    console, phone, lines = served
    with client(phone) as first, client(phone) as second:
        assert first.get("api/state").status_code == 403
        assert first.post("api/enter", json={"code": "nonono"}).status_code == 403
        code = phone.door.code
        assert f"code for the phone: {code}" in lines
        assert first.post("api/enter", json={"code": code}).json() == {"inside": True}
        assert phone.door.code != code, "a code lets one phone in"
        assert first.get("api/state").json()["name"] == "starting"
        answer = second.post("api/enter", json={"code": phone.door.code})
        assert answer.status_code == 409
        assert "another phone is the console" in answer.json()["error"]
        assert second.post("api/enter", json={"code": phone.door.code, "take_over": True}).status_code == 200
        assert "another phone has taken over" in first.get("api/state").json()["error"]
        first_code = phone.door.code
        for _ in range(5):
            first.post("api/enter", json={"code": "000000x"})
        assert phone.door.code != first_code, "guesses use a code up"
        page = second.get("")
        assert "frame-ancestors 'none'" in page.headers["content-security-policy"]
        other = second.post("api/press", json={"button": "stop"}, headers={"Origin": "http://elsewhere"})
        assert other.status_code == 403
    assert not console.stopped


def test_what_is_pressed_reaches_the_run_and_the_truth_of_the_lab_does_not_reach_the_phone(served):
    console, phone, _ = served
    said = []
    asked = threading.Thread(
        target=lambda: said.append(
            console.ask("verdict", "Done?", ("success", "invalid"), {"truth": {"objects": 1}, "code": "A"})
        )
    )
    asked.start()
    with client(phone) as user:
        user.post("api/enter", json={"code": phone.door.code})
        while (state := user.get("api/state").json())["name"] != "verdict":
            pass
        assert state["details"] == {"code": "A"}
        assert user.post("api/press", json={"button": "done"}).status_code == 409
        pressed = {"button": "invalid", "reason": "person", "note": "a hand"}
        for odd in (None, "1", state["version"] - 1, state["version"] + 1):
            assert user.post("api/press", json={**pressed, "version": odd}).status_code == 409
        user.post("api/press", json={**pressed, "version": state["version"]})
        asked.join(10)
        assert said[0].button == "invalid"
        assert said[0].values == {"reason": "person", "note": "a hand"}
        user.post("api/press", json={"button": "stop"})
        assert console.stopped
        assert user.post("api/leave", json={}).status_code == 200
    assert not console.phone_gone


def test_a_second_tap_does_not_answer_the_next_screen(served):
    """Both screens have a Go: the second tap must not say that hands are away."""
    console, phone, _ = served
    said = []
    asked = threading.Thread(
        target=lambda: said.extend(console.ask(name, "?", ("go", "skip")) for name in ("next", "clear"))
    )
    asked.start()
    with client(phone) as user:
        user.post("api/enter", json={"code": phone.door.code})
        while (first := user.get("api/state").json())["name"] != "next":
            pass
        tap = {"button": "go", "version": first["version"]}
        assert user.post("api/press", json=tap).status_code == 200
        while (second := user.get("api/state").json())["name"] != "clear":
            pass
        assert user.post("api/press", json=tap).status_code == 409
        assert len(said) == 1
        user.post("api/press", json={"button": "skip", "version": second["version"]})
        asked.join(10)
    assert [answer.button for answer in said] == ["go", "skip"]


def test_a_key_pressed_at_once_was_meant_for_the_screen_before():
    now = [0.0]
    console = Console(seconds=lambda: now[0])
    console.show("clear", buttons=("go",))
    assert not console.press_key("go")
    assert console.press_key("stop")
    now[0] = 1.0
    assert console.press_key("go")
    assert console.poll().button == "go"


def test_a_phone_that_does_not_ask_any_more_is_gone():
    now = [0.0]
    console = Console(seconds=lambda: now[0])
    assert not console.phone_gone
    console.heard()
    now[0] = 7.0
    assert not console.phone_gone
    now[0] = 9.0
    assert console.phone_gone


def test_a_taken_port_is_one_line(served):
    _, phone, _ = served
    port = int(phone.address.split(":")[2].split("/")[0])
    with pytest.raises(ScenarioError, match="Name another port, or 0 for a free one"):
        Phone(Console(), PhoneConfig(port=port))


@pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl is not installed")
def test_a_certificate_makes_it_https(tmp_path, monkeypatch):
    monkeypatch.setattr("lerobot_roborecover.robot.phone.server._LAST_LOOK_S", 0.0)
    words = (
        "openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes -days 2 -subj /CN=lab "
        "-addext subjectAltName=IP:127.0.0.1 -keyout key.pem -out certificate.pem"
    )
    subprocess.run(words.split(), cwd=tmp_path, check=True, capture_output=True)
    certificate, key = tmp_path / "certificate.pem", tmp_path / "key.pem"
    phone = Phone(Console(), PhoneConfig("127.0.0.1", 0, certificate, key), lambda line: None)
    try:
        assert phone.address.startswith("https://")
        trusted = ssl.create_default_context(cafile=str(certificate))
        with httpx.Client(base_url=phone.address, verify=trusted) as user:
            answer = user.post(
                "api/enter", json={"code": phone.door.code}, headers={"Origin": phone.address[:-9]}
            )
            assert "Secure" in answer.headers["set-cookie"]
            assert user.post("api/press", json={"button": "stop"}).status_code == 200
        with pytest.raises(httpx.ConnectError, match="self-signed"):
            httpx.get(phone.address)
        with pytest.raises(httpx.HTTPError):
            httpx.get(phone.address.replace("https", "http"))
    finally:
        phone.close()
    for pair in ((tmp_path / "none.pem", key), (certificate, tmp_path / "none.pem"), (key, key), (None, key)):
        with pytest.raises(ScenarioError, match="--tls_certificate") as err:
            Phone(Console(), PhoneConfig("127.0.0.1", 0, *pair), lambda line: None)
        assert "\n" not in str(err.value)


@pytest.mark.browser
def test_the_ghost_and_the_buttons_in_a_browser(served):
    console, phone, _ = served
    picture = np.full((48, 48, 3), 90, np.uint8)
    error = {"joints": {}, "problems": ["camera top: objects are 4.2 px off, at most 2"]}
    error["cameras"] = {"top": {"background_px": 0.1, "object_px": 4.2, "similarity": 0.9, "tag_mm": None}}
    said = []
    details = {"instruction": "push the puck", "start_error": error}

    def look():
        console.pictures = {"top": (picture, picture)}

    def run():
        said.append(console.ask("place", "Put it back.", ("done", "skip"), details, look))
        said.append(console.ask("verdict", "Done?", ("success", "failure", "invalid"), details, look))

    asked = threading.Thread(target=run)
    asked.start()
    with browsing() as visit:
        page, complaints = visit(phone.address)
        page.set_viewport_size({"width": 420, "height": 800})
        page.fill("#code", phone.door.code)
        page.click("#enter")
        page.wait_for_selector("#cameras img")
        page.wait_for_selector("text=top: camera 0.1 px, objects 4.2 px")
        assert page.inner_text("#problems") == error["problems"][0]
        page.click("text=edges")
        _fits(page)
        page.dblclick("#buttons [data-name=done]")
        page.wait_for_selector("#buttons [data-name=invalid]")
        page.wait_for_selector("#cameras img[src*='/live']")
        _fits(page)
        page.click("#buttons [data-name=success]")
        asked.join(20)
        page.click("#stop")
        page.wait_for_selector("text=STOPPED")
        # Before the code was typed the page asked whether it is inside, and was not.
        assert [c for c in complaints if "403" not in c] == []
    assert [answer.button for answer in said] == ["done", "success"]
    assert console.stopped


def _fits(page):
    """On a phone the picture takes the width, and the buttons are seen without scrolling."""
    # In one step: a live picture is replaced by the next, and Playwright would measure one that is gone.
    width = page.evaluate("document.querySelector('#cameras img').getBoundingClientRect().width")
    assert width > 300
    last = page.locator("#buttons button").last.bounding_box()
    assert last["x"] + last["width"] <= 420
    assert last["y"] + last["height"] <= 800


@pytest.mark.nightly
@pytest.mark.browser
def test_a_rater_sees_where_a_recording_ends_and_nothing_to_stop(served):
    console, phone, _ = served
    picture, moment, said = np.full((48, 48, 3), 90, np.uint8), [1], []

    def look():
        console.update(moment=moment[0], moments=3)
        console.pictures = {"top": (picture, picture)}

    def run():
        said.extend(console.ask("rate", f"Trial {k}", ("success", "failure"), {}, look) for k in (1, 2))

    asked = threading.Thread(target=run)
    asked.start()
    with browsing() as visit:
        page, _complaints = visit(phone.address)
        page.fill("#code", phone.door.code)
        page.click("#enter")
        page.wait_for_selector("text=top: 1 of 3")
        assert page.is_hidden("#stop")
        page.keyboard.press("Space")
        moment[0] = 3
        page.wait_for_selector("text=top: the end")
        page.dblclick("#buttons [data-name=success]")
        page.wait_for_selector("text=Trial 2")
        page.click("#buttons [data-name=failure]")
        asked.join(20)
    assert [answer.button for answer in said] == ["success", "failure"]
    assert not console.stopped


@pytest.mark.nightly
@pytest.mark.browser
def test_the_page_of_a_run_that_is_over_waits_for_the_next_command(monkeypatch):
    """Nothing is wrong once the command has ended; the next one is entered by its own code."""
    monkeypatch.setattr("lerobot_roborecover.robot.phone.server._LAST_LOOK_S", 0.0)
    console, lines = Console(), []
    picture = np.full((48, 48, 3), 90, np.uint8)
    wrist = {"background_px": 2.6, "object_px": None, "similarity": 0.9, "tag_mm": None}
    error = {"joints": {}, "problems": [], "cameras": {"wrist": wrist}}
    console.show("place", "Put it back.", ("done",), {"start_error": error, "on_the_arm": ["wrist"]})
    console.pictures = {"wrist": (picture, picture)}
    phone = Phone(console, PhoneConfig(port=0), lines.append)
    port = int(phone.address.split(":")[2].split("/")[0])
    with browsing() as visit:
        page, _complaints = visit(phone.address)
        page.fill("#code", phone.door.code)
        page.click("#enter")
        page.wait_for_selector("text=wrist: camera 2.6 px (on the arm: not counted)")
        assert page.get_attribute("#cameras figcaption", "class") == ""
        console.show("over", "1 trial of 2 done. The same command goes on with the others.")
        page.wait_for_selector("text=goes on with the others")
        assert page.is_hidden("#leave")
        phone.close()
        page.wait_for_timeout(1500)
        assert page.inner_text("#message") == ""
        again = Phone(Console(), PhoneConfig(port=port), lines.append)
        try:
            page.wait_for_selector("#door:not([hidden])")
            page.fill("#code", again.door.code)
            page.click("#enter")
            page.wait_for_selector("#inside:not([hidden])")
        finally:
            again.close()
