"""Benchmarks are scripts, whose folder comes first on the path of what they import."""

from __future__ import annotations

import importlib

import pytest


def test_the_benchmark_named_coverage_does_not_pass_for_the_library(monkeypatch, pytestconfig):
    monkeypatch.syspath_prepend(str(pytestconfig.rootpath / "benchmarks"))
    monkeypatch.delitem(importlib.sys.modules, "coverage", raising=False)
    with pytest.raises(ImportError, match="not the library"):
        importlib.import_module("coverage")
