"""Licences by the Hub's identifiers: a slip in one would publish data under a licence that does not exist."""

from __future__ import annotations

import argparse
import difflib
import re

from lerobot_roborecover.scenario import ScenarioError

_IDENTIFIERS = """
apache-2.0 mit openrail bigscience-openrail-m creativeml-openrail-m bigscience-bloom-rail-1.0
bigcode-openrail-m afl-3.0 artistic-2.0 bsl-1.0 bsd bsd-2-clause bsd-3-clause bsd-3-clause-clear c-uda cc
cc0-1.0 cc-by-2.0 cc-by-2.5 cc-by-3.0 cc-by-4.0 cc-by-sa-3.0 cc-by-sa-4.0 cc-by-nc-2.0 cc-by-nc-3.0
cc-by-nc-4.0 cc-by-nd-4.0 cc-by-nc-nd-3.0 cc-by-nc-nd-4.0 cc-by-nc-sa-2.0 cc-by-nc-sa-3.0 cc-by-nc-sa-4.0
cdla-sharing-1.0 cdla-permissive-1.0 cdla-permissive-2.0 wtfpl ecl-2.0 epl-1.0 epl-2.0 etalab-2.0 eupl-1.1
eupl-1.2 agpl-3.0 gfdl gpl gpl-2.0 gpl-3.0 lgpl lgpl-2.1 lgpl-3.0 isc h-research intel-research lppl-1.3c
ms-pl apple-ascl apple-amlr mpl-2.0 odc-by odbl openmdw-1.0 openrail++ osl-3.0 postgresql ofl-1.1 ncsa
unlicense zlib pddl lgpl-lr deepfloyd-if-license fair-noncommercial-research-license llama2 llama3 llama3.1
llama3.2 llama3.3 llama4 grok2-community gemma unknown other
"""
HUB_LICENSES = frozenset(_IDENTIFIERS.split())
"""What the Hub's metadata takes as a licence (https://huggingface.co/docs/hub/repositories-licenses)."""
_OWN = re.compile(r"other:([A-Za-z0-9][A-Za-z0-9.+_-]{0,80})")


def license_metadata(license: object) -> dict[str, str]:
    """The Hub's licence fields.

    Args:
        license: one of the Hub's identifiers, in any letter case; or `other:NAME` for one that it does not
            know.

    Raises:
        ScenarioError: none is given, which is the publisher's decision and never assumed; or it is neither.
    """
    if not license:
        raise ScenarioError(
            "no licence: the dataset's manifest names none. Give the one under which you publish, e.g. "
            "--license cc-by-4.0, or --license unknown"
        )
    text = str(license).strip()
    if text.lower() in HUB_LICENSES:
        return {"license": text.lower()}
    if own := _OWN.fullmatch(text):
        return {"license": "other", "license_name": own.group(1).lower()}
    near = difflib.get_close_matches(text.lower().replace(" ", "-"), HUB_LICENSES, 3, 0.5)
    raise ScenarioError(
        f"licence {text!r:.100} is none that the Hub knows"
        + (f"; do you mean {' or '.join(near)}?" if near else "; e.g. cc-by-4.0.")
        + " For one that it does not know say other:NAME"
    )


def license_argument(text: str) -> str:
    """Returns a licence from the command line as given; refuses one that `license_metadata` refuses."""
    try:
        license_metadata(text)
    except ScenarioError as err:
        raise argparse.ArgumentTypeError(str(err)) from None
    return text


def add_license(parser: argparse.ArgumentParser) -> None:
    """Adds the option `--license` of a script that converts data."""
    text = "licence by the Hub's identifier, of the data; none is assumed"
    parser.add_argument("--license", type=license_argument, help=text)
