"""Which files and folders a policy's identity is made of."""

from __future__ import annotations

import json
import os

import pytest

from lerobot_roborecover.policies.identity import (
    content_hash,
    file_sha256,
    policy_identity,
)

pytestmark = pytest.mark.lerobot


def test_the_middle_of_a_large_file_counts(tmp_path):
    weights = tmp_path / "act" / "model.safetensors"
    weights.parent.mkdir()
    with open(weights, "wb") as file:
        file.truncate(300 * 2**20)
    before = policy_identity(weights.parent)
    with open(weights, "r+b") as file:
        file.seek(150 * 2**20 + 12345)
        file.write(b"x")
    assert policy_identity(weights.parent) != before


def test_a_settled_file_is_read_once(tmp_path, monkeypatch):
    import hashlib

    file = tmp_path / "model.safetensors"
    file.write_bytes(b"weights")
    settled = file.stat()
    monkeypatch.setattr("lerobot_roborecover.policies.identity._SETTLED_NS", -(10**18))
    first, read = file_sha256(file), []
    digest = hashlib.file_digest
    monkeypatch.setattr(hashlib, "file_digest", lambda *a: read.append(1) or digest(*a))
    assert file_sha256(file) == first
    assert not read
    file.write_bytes(b"Weights")
    os.utime(file, ns=(settled.st_atime_ns, settled.st_mtime_ns))
    assert file_sha256(file) != first, "same path, size and mtime"


def test_folders_that_a_configuration_names_count(tmp_path):
    policy, tokenizer = tmp_path / "act", tmp_path / "tokenizer"
    policy.mkdir(), tokenizer.mkdir()
    (tokenizer / "vocab.txt").write_text("a")
    steps = [{"registry_name": "tokenizer_processor", "config": {"tokenizer_name": str(tokenizer)}}]
    (policy / "policy_preprocessor.json").write_text(json.dumps({"steps": steps}))
    (policy / "config.json").write_text(json.dumps({"pretrained_path": str(tmp_path), "vlm": str(policy)}))
    before = content_hash(policy)
    (tmp_path / "notes.txt").write_text("of the folder that the training began with")
    assert content_hash(policy) == before
    (tokenizer / "vocab.txt").write_text("b")
    assert content_hash(policy) != before
