"""No option of today vanishes or changes its meaning unnoticed."""

from __future__ import annotations

import pytest

from tests.support.option_table import lerobots_options, our_options, plain, written

RENEW = "where that is meant, write the table anew and look at its diff: python -m tests.support.option_table"


def compare(found: dict, table: str) -> None:
    before = written(table)
    assert sorted(found) == sorted(before), RENEW
    for command, options in before.items():
        gone = sorted(set(options) - set(found[command]))
        assert not gone, f"{command} has no {', '.join(gone)} any more; {RENEW}"
        new = sorted(set(found[command]) - set(options))
        assert not new, f"{command} has {', '.join(new)}, which the table lacks; {RENEW}"
        for name, said in options.items():
            assert found[command][name] == said, f"{command} {name}; {RENEW}"


def test_options_of_our_parsers_are_those_of_the_table():
    compare(plain(our_options()), "ours")


@pytest.mark.lerobot
def test_options_that_lerobots_parser_reads_are_those_of_the_table():
    compare(plain(lerobots_options()), "lerobots")


def test_a_missing_option_is_noticed():
    found = plain(our_options())
    del found["curate split"]["--seed"]
    with pytest.raises(AssertionError, match="curate split has no --seed any more; where that is meant"):
        compare(found, "ours")
