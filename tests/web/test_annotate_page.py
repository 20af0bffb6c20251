"""The annotation page in a real browser, with the keyboard alone, against the real server process."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from contextlib import contextmanager

import pytest

from lerobot_roborecover.curation.annotation.discussion import Discussion
from lerobot_roborecover.curation.annotation.votes import Vote
from lerobot_roborecover.curation.candidates import read_candidates
from lerobot_roborecover.utils.journal import read_journal
from lerobot_roborecover.web.annotate.identity import names_of, queue_order
from tests.support.annotation_page import (
    CALLED,
    EPISODES,
    at,
    close_guide,
    opened,
    press,
    shown,
    votes,
)
from tests.support.browser import browsing
from tests.support.candidate_files import CAMERAS, STEPS, candidate_dataset
from tests.support.processes import PATIENCE_S

pytestmark = pytest.mark.browser


@pytest.fixture(scope="module")
def browse():
    with browsing() as visit:
        yield visit


@pytest.fixture(scope="module")
def visit(browse):
    """Opens an address, and closes the guide that a first visit opens."""

    def opened(url: str) -> tuple:
        page, said = browse(url)
        close_guide(page)
        return page, said

    return opened


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    root = candidate_dataset(tmp_path_factory.mktemp("sets") / "rollouts", EPISODES)
    CALLED.update(names_of(read_candidates(root), root).episodes)
    return root


@contextmanager
def annotating(dataset, folder, *names: str, port: int = 0, only=None):
    """`roborecover curate annotate` as a process; yields it and each annotator's address."""
    command = [
        sys.executable,
        "-m",
        "lerobot_roborecover.cli.main",
        "annotate",
        str(dataset),
        "--no-examples",
    ]
    command += ["--port", str(port), "--votes", str(folder / "votes")]
    command += ["--only", str(only)] if only else []
    process = subprocess.Popen(
        [*command, *(f"--annotator={n}" for n in names)], stdout=subprocess.PIPE, text=True,
        env={**os.environ, "XDG_STATE_HOME": str(folder)},
    )  # fmt: skip
    try:
        yield process, {n: process.stdout.readline().split()[-1] for n in names}
    finally:
        running = process.poll() is None
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0 or not running


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("study")


@pytest.fixture(scope="module")
def server(dataset, folder):
    """One server; each test has annotators of its own."""
    with annotating(dataset, folder, "ann", "bob", "cleo", "dan", "eve", "fay") as (_process, addresses):
        yield addresses


def test_two_annotators_at_once_with_the_keyboard_alone(server, visit, folder):
    (ann, ann_said), (bob, bob_said) = visit(server["ann"]), visit(server["bob"])
    assert "token" not in ann.url
    first, other = at(ann, 0, "ann"), at(bob, 0, "bob")
    assert first != other
    press(ann, "Shift+ArrowRight", "ArrowRight", "r", "Shift+ArrowRight", "ArrowLeft", "c")
    press(bob, "End", "ArrowLeft", "r", "p")
    assert shown(ann, 20) == [20, 20]
    assert shown(bob, STEPS - 2) == [STEPS - 2] * 2
    press(ann, "2", "k")
    ann.keyboard.type("<img src=x onerror=alert(1)> 1 2 r")
    press(ann, "Escape", "Enter")
    press(bob, "3", "Enter")
    at(ann, 1, "ann")
    second = at(bob, 1, "bob")
    press(bob, "d")
    bob.wait_for_selector("dialog[open]")
    press(bob, "5")
    at(bob, 2, "bob")
    for page in (ann, bob):
        page.wait_for_selector('body[data-waiting="0"]')
    assert votes(folder, "ann") == {first: ("recovery", 11, "Contact", "Wrong Pose", "")}
    assert votes(folder, "bob") == {
        other: ("recovery", STEPS - 2, "Place", "Stage Rollback", ""),
        second: ("discard", None, "", "", "stuck"),
    }
    # Back to the first one: the comment is text again, and so is everything else.
    press(ann, "b")
    at(ann, 0, "ann")
    assert ann.input_value("#comment") == "<img src=x onerror=alert(1)> 1 2 r"
    assert ann.locator("img").count() == 0
    press(bob, "u")
    at(bob, 1, "bob")
    bob.wait_for_selector('#done:text-is("1")')
    assert list(votes(folder, "bob")) == [other]
    assert (ann_said, bob_said) == ([], [])


def test_nothing_is_saved_before_all_is_marked_and_suggestions_wait_for_the_vote(server, visit, folder):
    page, _ = visit(server["cleo"])
    first = at(page, 0, "cleo")
    press(page, "Enter", "a", "Enter", "r")
    assert "earliest" in page.inner_text("#message")
    press(page, "s")
    assert "once the episode has your vote" in page.inner_text("#message")
    assert page.is_hidden("#suggest")
    press(page, "Shift+ArrowRight", "r", "1", "Enter")
    at(page, 1, "cleo")
    press(page, "b")
    at(page, 0, "cleo")
    press(page, "s")
    page.wait_for_selector("#suggestions li")
    assert "frame 17 suggested by model: Contact Wrong Pose the arm stops" in page.inner_text("#suggestions")
    press(page, "g")
    page.wait_for_selector("#guide[open] .cells .none")
    assert page.locator("#guide .cells figure").count() == 9
    press(page, "g")
    assert votes(folder, "cleo") == {first: ("recovery", 10, "Approach", "Wrong Target", "")}


def test_a_reload_in_the_middle_of_an_episode_keeps_marks_and_place(server, visit):
    page, _ = visit(server["dan"])
    at(page, 0, "dan")
    press(page, "n")
    at(page, 1, "dan")
    press(page, "Shift+ArrowRight", "r", "m", "4", "ArrowRight", "ArrowRight")
    page.reload()
    at(page, 1, "dan")
    assert shown(page, 12) == [12, 12]
    assert page.inner_text("#marked") == "frame 10"
    assert page.locator('button[aria-pressed="true"]').all_inner_texts() == ["M Move", "4 Scene Change"]
    press(page, "j")
    assert shown(page, 10) == [10, 10]


@pytest.mark.nightly
def test_a_killed_server_loses_no_vote(dataset, visit, tmp_path):
    with annotating(dataset, tmp_path, "ann") as (process, addresses):
        page, _ = visit(addresses["ann"])
        first = at(page, 0, "ann")
        press(page, "Shift+ArrowRight", "r", "a", "1", "Enter")
        second = at(page, 1, "ann")
        page.wait_for_selector('body[data-waiting="0"]')
        page.wait_for_selector("#loading:empty", state="attached")
        process.kill()
        process.wait()
        port = int(addresses["ann"].split(":")[2].split("/")[0])
    # The next vote is cast while there is no server.
    press(page, "Shift+ArrowRight", "ArrowRight", "r", "p", "2", "Enter")
    page.wait_for_selector("#saved.waiting")
    assert votes(tmp_path, "ann") == {first: ("recovery", 10, "Approach", "Wrong Target", "")}
    with annotating(dataset, tmp_path, "ann", port=port) as (_process, again):
        assert again == addresses
        page.wait_for_selector('body[data-waiting="0"]')
        at(page, 2, "ann")
        assert votes(tmp_path, "ann") == {
            first: ("recovery", 10, "Approach", "Wrong Target", ""),
            second: ("recovery", 11, "Place", "Wrong Pose", ""),
        }
        journal = read_journal(tmp_path / "votes/ann.jsonl", 1)
        assert len(journal) == 2, json.dumps(journal)
        page.reload()
        at(page, 2, "ann")
        assert page.inner_text("#done") == "2"


@pytest.mark.nightly
def test_scrubbing_among_a_thousand_episodes_asks_the_server_for_nothing(server, visit):
    """All frames of the episode at hand lie in the page: what a key costs does not depend on the queue."""
    page, said = visit(server["eve"])
    at(page, 0, "eve")
    assert page.inner_text("#total") == str(EPISODES)
    page.wait_for_selector("body[data-ahead]")  # nothing is on its way any more
    asked: list[str] = []
    page.on("request", lambda made: asked.append(made.url))
    for step in range(1, STEPS):
        press(page, "ArrowRight")
        assert shown(page, step) == [step] * len(CAMERAS)
    press(page, "Home")
    assert shown(page, 0) == [0, 0]
    press(page, "Space")
    page.wait_for_selector(f'#cameras canvas[data-step="{STEPS - 1}"]')
    assert asked == []
    # The next episode is there already, too.
    press(page, "t")
    following = at(page, 1, "eve")
    assert not [url for url in asked if f"{CALLED[following]}/frames" in url]
    # The warning is about how this test reads pixels.
    assert [text for text in said if "getImageData" not in text] == []


def test_buttons_take_tab_enter_and_space_and_a_first_visit_opens_the_guide(server, browse, folder):
    page, said = browse(server["fay"])
    page.wait_for_selector("#guide[open]")
    page.wait_for_selector("#guide .cells figure:nth-child(9)")
    assert page.evaluate("document.activeElement.id") == "close-guide"
    press(page, "Enter")
    page.wait_for_selector("#guide:not([open])", state="attached")
    first = at(page, 0, "fay")
    assert page.inner_text("#saved") == "draft"
    press(page, "Enter")
    assert page.inner_text("#message") == "not saved: missing: point, stage, type"
    press(page, "Shift+ArrowRight")
    page.focus("#mark")
    press(page, "Space")
    assert page.inner_text("#marked") == "frame 10"
    press(page, "Tab", "Enter", "Tab", "Tab", "Tab", "Tab", "Space")
    assert page.locator('button[aria-pressed="true"]').all_inner_texts() == ["A Approach", "1 Wrong Target"]
    # A button that was clicked gives the keyboard back: Space plays.
    page.click('button[data-name="Wrong Pose"]')
    press(page, "Space")
    page.wait_for_selector("#play.on")
    press(page, "Space")
    page.focus("#submit")
    press(page, "Space")
    second = at(page, 1, "fay")
    assert page.inner_text("#saved") in ("draft", "saving…")
    page.focus("#discard")
    press(page, "Enter")
    page.wait_for_selector("#reasons[open]")
    press(page, "Tab", "Tab", "Space")
    at(page, 2, "fay")
    page.wait_for_selector('body[data-waiting="0"]')
    press(page, "b")
    at(page, 1, "fay")
    assert page.inner_text("#saved") == "✓ saved"
    assert "your vote: discard (nothing goes wrong)" in page.inner_text("#about")
    assert votes(folder, "fay") == {
        first: ("recovery", 10, "Approach", "Wrong Pose", ""),
        second: ("discard", None, "", "", "no_deviation"),
    }
    # Names for people, and nothing that would tell the controller.
    assert page.locator("#cameras figcaption").all_inner_texts() == ["top camera", "wrist camera"]
    assert page.locator('#keys [data-row="action"] span').all_inner_texts() == ["action 1", "action 2"]
    seen = page.evaluate("document.title + location + document.body.innerHTML + JSON.stringify(localStorage)")
    assert [word for word in ("ep-0", "rollouts", "noise", "observation.") if word in seen] == []
    page.reload()
    at(page, 1, "fay")
    assert not page.locator("#guide[open]").count()
    assert said == []


OUTSIDE = """() => [
  ...document.querySelectorAll("main button, #message, #cameras canvas, #plots, #comment, #discussion")
].filter((e) => e.checkVisibility()).filter((e) => {
    const box = e.getBoundingClientRect();
    const at = document.elementFromPoint(box.left + box.width / 2, box.top + box.height / 2);
    const over = box.top < 0 || box.left < 0 || box.bottom > innerHeight || box.right > innerWidth;
    return over || !(e.contains(at) || at?.contains(e));
  }).map((e) => e.id || e.outerHTML)"""


@pytest.mark.nightly
def test_all_is_in_sight_in_a_discussion_at_1024_by_700(browse, tmp_path, dataset):
    """A human-made episode with three votes and comments: the fullest that the page gets."""
    small = candidate_dataset(tmp_path / "rollouts", 6)
    comment = "the hand pushes the puck beyond its reach, and comes back without it"
    said = [
        Vote("uid-00000001", "ep-0004", "recovery", 20, "Move", "Wrong Pose", comment=comment),
        Vote("uid-00000002", "ep-0004", "recovery", 31, "Move", "Stage Rollback", comment=comment),
        Vote("uid-00000003", "ep-0004", "discard", reason="unclear", comment=comment),
    ]
    Discussion.of(2, {"ep-0004": ("no majority: recovery point", said)}).write(tmp_path / "only.json")
    with annotating(small, tmp_path, "ann", only=tmp_path / "only.json") as (_process, addresses):
        page, complaints = browse(addresses["ann"])
        close_guide(page)
        opened(page, "ep-0004")
        assert page.inner_text("#discussion").count(comment) == 3
        for width, height in ((1024, 700), (1400, 900)):
            page.set_viewport_size({"width": width, "height": height})
            press(page, "Enter")
            assert "missing" in page.inner_text("#message")
            assert page.evaluate(OUTSIDE) == []
            pictures, plots = (page.locator(q).first.bounding_box() for q in ("#cameras canvas", "#plots"))
            assert (pictures["height"] > 240, plots["height"] > 120) == (True, True), (pictures, plots)
        # On a telephone the page scrolls, and Save and its answer stay.
        page.set_viewport_size({"width": 390, "height": 800})
        for top in (0, 10**6):
            page.evaluate(f"scrollTo(0, {top})")
            boxes = [page.locator(q).bounding_box() for q in ("#submit", "#message")]
            assert all(b["y"] >= 0 and b["y"] + b["height"] <= 800 for b in boxes)
        assert page.evaluate("document.documentElement.scrollWidth") <= 390
        assert complaints == []


DISCARD = {
    "verdict": "discard", "reason": "stuck", "step": None, "stage": "", "deviation": "", "comment": "",
    "seconds": 1,
}  # fmt: skip
KEEP = """([bad, old]) => {
  const own = Object.keys(localStorage).find((key) => key.includes("/draft/")).split("/draft/")[0];
  const dataset = document.querySelector("#who").textContent.split("set ")[1];
  const shelf = own.replace(own.split("/")[2], Object.keys(localStorage).map((k) => k.split("/")[2])
    .find((name) => name?.startsWith(dataset)));
  localStorage.setItem(`${shelf}/outbox`, JSON.stringify([{ ...bad, dataset: shelf.split("/")[2] }]));
  localStorage.setItem("rr/candidates/ann/1/outbox", JSON.stringify([old]));
}"""


@pytest.mark.nightly
def test_a_vote_reaches_its_own_dataset_or_stays_and_is_shown(browse, tmp_path, dataset):
    """Two datasets in folders of one base name with the same ids, one after the other on one port."""
    sets = {n: candidate_dataset(tmp_path / n / "candidates", 3) for n in ("a", "b")}
    queue = queue_order([f"ep-{i:04d}" for i in range(3)], "ann", 0)
    with annotating(sets["a"], tmp_path / "a", "ann") as (process, first):
        page, _ = browse(first["ann"])
        close_guide(page)
        opened(page, queue[0])
        page.wait_for_selector("#loading:empty", state="attached")
        process.kill()
        process.wait()
        port = int(first["ann"].split(":")[2].split("/")[0])
    press(page, "Shift+ArrowRight", "r", "a", "1", "Enter")
    page.wait_for_selector("#saved.waiting")
    with annotating(sets["b"], tmp_path / "b", "ann", port=port) as (_process, second):
        page.goto(second["ann"])
        opened(page, queue[0])
        press(page, "ArrowRight")
        page.wait_for_selector('#kept:has-text("1 vote of another dataset")')
        with page.expect_download() as download:
            page.click('#kept button:text-is("Export")')
        exported = json.loads(download.value.path().read_text())
        assert [v["candidate"] for v in exported["votes"]] == [CALLED[queue[0]]]
        # Nor does it go the other way round: what this server refuses, and what an earlier version kept.
        page.reload()
        opened(page, queue[0])
        bad = {**DISCARD, "uid": "uid-00000001", "candidate": "0123456789ab"}
        page.evaluate(KEEP, [bad, {**DISCARD, "uid": "uid-00000002", "candidate": queue[2]}])
        for _ in range(2):
            page.reload()
            page.wait_for_selector('#kept:has-text("1 vote refused by the server and kept")')
            page.wait_for_selector('#kept:has-text("earlier version of this page kept 1 vote")')
            assert "there is no episode '0123456789ab'" in page.inner_text("#kept")
            assert "another dataset" in page.inner_text("#kept")
        assert page.inner_text("#done") == "0"
        page.click('#kept button:text-is("They are of this dataset: take over")')
        page.wait_for_selector('#done:text-is("1")')
        page.wait_for_selector('body[data-waiting="0"]')
        assert votes(tmp_path / "b", "ann") == {queue[2]: ("discard", None, "", "", "stuck")}
        line = page.locator("#kept p", has_text="refused")
        line.locator("button", has_text="Discard").click()
        line.locator("button", has_text="Really").click()
        page.wait_for_selector('#kept:not(:has-text("refused"))')
        # Both at once, for one annotator in one browser: neither takes the other's cookie away.
        with annotating(sets["a"], tmp_path / "a", "ann") as (_process, other):
            beside = page.context.new_page()
            beside.goto(other["ann"])
            close_guide(beside)
            opened(beside, queue[0])
            for each in (page, beside):
                each.reload()
                opened(each, queue[0])
    with annotating(sets["a"], tmp_path / "a", "ann", port=port) as (_process, again):
        assert votes(tmp_path / "a", "ann") == {}
        page.goto(again["ann"])
        page.wait_for_selector('#done:text-is("1")')
        page.wait_for_selector('body[data-waiting="0"]')
        assert page.is_hidden("#kept")
        assert votes(tmp_path / "a", "ann") == {queue[0]: ("recovery", 10, "Approach", "Wrong Target", "")}
