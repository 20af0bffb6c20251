"""The scenarios that tests of the demo share."""

import pytest

from tests.support.factories import fake_dataset


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return fake_dataset(tmp_path_factory.mktemp("fake") / "set", 4, horizon=20)
