"""The static Space: a page of boards, a gallery of each, two policies side by side, videos."""

from __future__ import annotations

from dataclasses import replace

import pytest
import yaml

from lerobot_roborecover.analysis.leaderboard import make_leaderboard
from lerobot_roborecover.analysis.options import Options
from lerobot_roborecover.analysis.pages.media import find_media
from lerobot_roborecover.analysis.pages.space import SpaceConfig, write_space
from lerobot_roborecover.analysis.stats.estimators import RowsError
from lerobot_roborecover.datasets import load_scenarios
from tests.support.browser import open_page
from tests.support.trial_rows import policy_rows, trial_row, write_log

COUNT = 12


@pytest.fixture(scope="module")
def space(tmp_path_factory):
    """Boards of two policies on a shipped set, and of one on a set that is not available."""
    root = tmp_path_factory.mktemp("space")
    scenarios = list(load_scenarios("metaworld_starter"))[:COUNT]
    for seed, policy in enumerate(("me/alpha@1", "me/beta@2")):
        rows = policy_rows(policy, COUNT, 2, 0.5, seed) + policy_rows(
            policy, COUNT, 1, 0.9, seed + 9, start="initial"
        )
        rows = [
            replace(
                row, scenario_id=s.id, scenario_sha256=s.sha256(), platform="metaworld",
                dataset="metaworld_starter", dataset_revision=None,
            )
            for row in rows
            for s in [scenarios[int(row.scenario_id[1:])]]
        ]  # fmt: skip
        write_log(root / "logs" / f"{seed}.jsonl", rows)
    write_log(root / "logs" / "other.jsonl", [trial_row(n, dataset="nobody/has") for n in range(3)])
    for policy in ("alpha", "beta"):
        path = root / policy / f"{scenarios[0].id}_trial0_success.mp4"
        path.parent.mkdir()
        path.write_bytes(b"\0\0\0\x18ftypmp42")
    (root / "beta" / f"{scenarios[1].id}.rrd").write_bytes(b"RRF2")
    found = make_leaderboard(root / "logs", Options(draws=200))
    media = [("me/alpha@1", root / "alpha"), ("me/beta@2", root / "beta"), ("nobody", root / "beta")]
    remarks = write_space(found, root / "out", SpaceConfig("Our board", media=media))
    return root / "out", remarks, scenarios


def test_the_files_of_a_space(space):
    out, remarks, scenarios = space
    front = yaml.safe_load((out / "README.md").read_text().split("---\n")[1])
    assert (front["sdk"], front["app_file"], front["title"]) == ("static", "index.html", "Our board")
    assert front["datasets"] == ["nobody/has"]
    assert sum("Certificate of the set: " in p.read_text() for p in out.glob("scenarios-*.html")) == 1
    assert {p.name for p in out.glob("*.html")} == {"index.html", "scenarios-1.html", "scenarios-2.html"}
    assert (out / "media" / "0-me-alpha-1" / f"{scenarios[0].id}.mp4").is_file()
    assert any("nobody/has: no pictures: " in r or "nobody/has@r1, test: no pictures: " in r for r in remarks)
    assert any("videos of nobody: no policy" in r for r in remarks)
    assert any(f"{COUNT} scenarios have no picture" in r and "--render" in r for r in remarks)


def test_media_are_found_by_their_commands_names(tmp_path):
    for name in (
        "libero_goal_s1/eval_episode_0.mp4", "libero_goal_s1/eval_episode_1.mp4", "s2_trial1_horizon.mp4",
        "s2_trial0_success.mp4", "s3/replay.rrd", "s4.mp4", "xs5.mp4", "s6.txt",
    ):  # fmt: skip
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    found = find_media(tmp_path, [f"s{n}" for n in range(1, 7)])
    names = {i: [(trial, str(p.relative_to(tmp_path))) for trial, p in media] for i, media in found.items()}
    assert names == {
        "s1": [(0, "libero_goal_s1/eval_episode_0.mp4")],
        "s2": [(0, "s2_trial0_success.mp4"), (1, "s2_trial1_horizon.mp4")],
        "s3": [(0, "s3/replay.rrd")],
        "s4": [(0, "s4.mp4")],
    }
    with pytest.raises(RowsError, match="no folder of videos"):
        find_media(tmp_path / "none", ["s1"])


def test_videos_beside_the_logs_are_found_without_being_named(tmp_path):
    for policy in ("a", "b", "c"):
        log = tmp_path / "logs" / {"c": "b"}.get(policy, policy) / f"{policy}.jsonl"
        write_log(log, [trial_row(0, policy=policy), trial_row(0, policy=policy, start="initial")])
        (log.parent / "videos").mkdir(exist_ok=True)
        for name in ("s000_trial0_success", "s000_initial_trial0_success"):
            (log.parent / "videos" / f"{name}.mp4").write_bytes(policy.encode())
    write_space(make_leaderboard(tmp_path / "logs", Options(draws=100)), tmp_path / "out")
    found = {str(p.relative_to(tmp_path / "out")) for p in (tmp_path / "out" / "media").rglob("*.mp4")}
    assert found == {"media/0-a/s000.mp4"}, "b and c share a folder, whose names do not tell them apart"
    assert 'src="media/0-a/s000.mp4"' in (tmp_path / "out" / "scenarios-1.html").read_text()


def shown(page):
    return page.eval_on_selector_all(
        "#cards > li", "cards => cards.filter(c => c.offsetParent).map(c => c.dataset.id)"
    )


@pytest.mark.nightly
@pytest.mark.browser
def test_two_policies_side_by_side(space, tmp_path):
    out, _, scenarios = space
    with open_page(out / "index.html", tmp_path / "profile") as (page, complaints):
        links = page.locator("p > a[href^=scenarios-]:not([href*='#'])")
        assert links.count() == 2
        assert page.locator("#submit pre").count() == 1
        assert page.locator(".pair video").count() == 2
        assert page.locator(".first img[alt^='Success in per cent']").count() == 1
        page.set_viewport_size({"width": 375, "height": 800})
        assert page.evaluate("document.documentElement.scrollWidth") <= 375
        page.set_viewport_size({"width": 1200, "height": 900})
        page.goto((out / "scenarios-2.html").as_uri())
        if page.locator("#cards > li").count() != COUNT:
            page.goto((out / "scenarios-1.html").as_uri())
        assert len(shown(page)) == COUNT
        first = page.locator(f"#cards > li[data-id='{scenarios[0].id}']")
        assert first.locator("video").count() == 2
        page.select_option("#pair-a", "me/beta@2")
        page.select_option("#pair-b", "me/alpha@1")
        assert page.locator("#cards.paired").count() == 1
        names = first.locator(".clips > div:visible").evaluate_all(
            "parts => parts.sort((a, b) => a.style.order - b.style.order).map(p => p.dataset.policy)"
        )
        assert names == ["me/beta@2", "me/alpha@1"]
        both = shown(page)
        better = {}
        for where in ("a", "b", "differ"):
            page.select_option("#pair-where", where)
            better[where] = set(shown(page))
        assert better["a"] | better["b"] == better["differ"] < set(both)
        assert not better["a"] & better["b"]
        page.click("form button[type=reset]")
        page.locator("#cards:not(.paired)").wait_for()
        assert len(shown(page)) == COUNT
        page.click("nav a")
        assert page.locator("h1").text_content() == "Our board"
        assert [c for c in complaints if "media" not in c] == []
