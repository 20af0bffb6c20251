"""The dataset card that is published: composition, metadata, licence and pictures."""

from __future__ import annotations

import io
import json

import pytest
import yaml
from PIL import Image

from lerobot_roborecover.datasets import write_scenarios
from lerobot_roborecover.datasets.card import license_metadata, make_card
from lerobot_roborecover.scenario import ScenarioError
from tests.support.factories import fake_dataset, fake_scenario
from tests.support.hub_client import REPO, commit_of


@pytest.fixture
def local(tmp_path):
    return fake_dataset(tmp_path / "local", 6)


@pytest.mark.slow
def test_the_card_says_what_is_there_and_its_metadata_is_valid(hub, client, local):
    from huggingface_hub import DatasetCardData

    commit = commit_of(client.publish(local, "--title", "Our | <set>"))
    card = hub.repos[REPO].commits[commit]["README.md"].decode()
    _, front, text = card.split("---\n", 2)
    metadata = yaml.safe_load(front)
    assert metadata["license"] == "cc-by-4.0"
    assert metadata["task_categories"] == ["robotics"]
    assert {"LeRobot", "RoboRecover"} <= set(metadata["tags"])
    assert yaml.safe_load(DatasetCardData(**metadata).to_yaml()) == metadata
    for piece in (
        "6 scenarios of 2 tasks",
        "| natural | 3 | 3 |",
        "| Approach | - | 2 | - | - |\n",
        f"--env.scenarios={REPO} --env.revision=roborecover-1.0.0",
        json.loads((local / "meta/roborecover/manifest.json").read_text())["files"]["scenarios.parquet"][
            "sha256"
        ],
        "Our \\| &lt;set\\>",
    ):
        assert piece in text, piece


@pytest.mark.slow
def test_a_licence_is_asked_for_and_never_invented(hub, client, local):
    done = client.roborecover("publish", local, "--repo-id", REPO)
    assert done.returncode == 2
    assert "no licence" in done.stderr
    assert "--license" in done.stderr
    assert not hub.log
    assert license_metadata("CC-BY-4.0") == {"license": "cc-by-4.0"}
    assert license_metadata("other:ACME-1.0") == {"license": "other", "license_name": "acme-1.0"}
    for wrong, near in (("cc-by-40", "cc-by-4.0"), ("apache2", "apache-2.0"), ("ACME-1.0", "other:NAME")):
        with pytest.raises(ScenarioError, match=rf"{wrong}.* is none that the Hub knows.*{near}"):
            license_metadata(wrong)
    refused = client.roborecover("publish", local, "--repo-id", REPO, "--license", "cc-by-40")
    assert refused.returncode == 2
    assert "do you mean cc-by-4.0" in refused.stderr
    assert not hub.log


@pytest.mark.slow
def test_frames_of_the_fingerprint_make_the_grid_of_the_card(hub, client, tmp_path):
    buffer = io.BytesIO()
    Image.new("RGB", (32, 32), (200, 30, 30)).save(buffer, "PNG")
    scenarios = [fake_scenario(i) for i in range(3)]
    for s in scenarios:
        object.__setattr__(s.fingerprint, "frames_png", (buffer.getvalue(),))
    local = write_scenarios(tmp_path / "set", scenarios)
    commit = commit_of(client.publish(local))
    hub_files = hub.repos[REPO].commits[commit]
    assert b"![Recovery frames](assets/recovery_frames.png)" in hub_files["README.md"]
    with Image.open(io.BytesIO(hub_files["assets/recovery_frames.png"])) as grid:
        assert grid.size == (3 * 264 + 8, 306)
        assert grid.convert("RGB").getpixel((136, 136)) == (200, 30, 30)
    bare = client.publish(local, "--no-pictures", "--version", "2.0")
    assert "assets/recovery_frames.png" not in hub.repos[REPO].commits[commit_of(bare)]


@pytest.mark.nightly
def test_pictures_are_rendered_for_the_card_where_the_dataset_has_none(hub, client, local):
    plain = client.publish(local)
    assert "assets/recovery_frames.png" not in hub.repos[REPO].commits[commit_of(plain)]
    done = client.publish(local, "--render-pictures", "--version", "2.0")
    grid = hub.repos[REPO].commits[commit_of(done)]["assets/recovery_frames.png"]
    with Image.open(io.BytesIO(grid)) as image:
        assert image.size == (4 * 264 + 8, 2 * 298 + 8)
        assert len(image.convert("RGB").crop((8, 8, 264, 264)).getcolors(10**6)) > 5


@pytest.mark.parametrize("change", [{"written_by": None}, {"license": ["mit"]}, {"written_by": {}}])
def test_a_manifest_without_what_the_card_shows_is_refused(local, change):
    path = local / "meta/roborecover/manifest.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "license": "mit", **change}))
    with pytest.raises(ScenarioError, match=r"manifest lacks|none that the Hub knows"):
        make_card(local, REPO, license=None, version="1.0.0", tag="roborecover-1.0.0")
