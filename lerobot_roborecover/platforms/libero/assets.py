"""Finds LIBERO's asset folder and makes `import libero.libero` silent, before anything heavy is imported.

LIBERO asks on standard input where to keep data sets when it has no `config.yaml`, ignores that file's
`assets:` key, and takes any folder with four sub-folders for complete. Here: never a prompt, the key
is honoured, and a folder counts as complete only if every file that the forty tasks load is there.
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from lerobot_roborecover.platforms.simulator import SimulatorError
from lerobot_roborecover.utils.atomic_io import atomic_write
from lerobot_roborecover.utils.temporary import TemporaryFolder
from lerobot_roborecover.utils.text import install_command

ASSETS_VARIABLE = "ROBORECOVER_LIBERO_ASSETS"
"""Environment variable that names the asset folder."""
HUB_REPOSITORY = "lerobot/libero-assets"
"""Where hf-libero downloads its assets from (libero/libero/utils/download_utils.py)."""
HUB_REVISION = "0b3ea86be5fe169d0fd036ae63d1070ec09e90f6"
"""The commit that is downloaded: its address is a hash of all of its files."""

_MODELS = {
    "articulated_objects/{}.xml": "flat_stove microwave white_cabinet wooden_cabinet",
    "scenes/libero_{}_base_style.xml": "floor kitchen_tabletop living_room_tabletop study tabletop",
    "stable_hope_objects/{0}/{0}.xml": "alphabet_soup bbq_sauce butter chocolate_pudding cookies "
    "cream_cheese ketchup milk orange_juice salad_dressing tomato_sauce",
    "stable_scanned_objects/{0}/{0}.xml": "akita_black_bowl basket chefmate_8_frypan "
    "glazed_rim_porcelain_ramekin plate",
    "turbosquid_objects/{0}/{0}.xml": "black_book desk_caddy moka_pot porcelain_mug red_coffee_mug "
    "white_yellow_mug wine_bottle wine_rack",
}
"""What the forty tasks of the four suites load, by path pattern."""
_TEXTURES = (
    "gray_ceramic_tile light-gray-floor-tile light-gray-plaster martin_novak_wood_table "
    "seamless_wood_planks_floor yellow_linen_wall_texture"
)
"""Wall and floor textures, which LIBERO names in Python (libero/libero/envs/arenas/style.py)."""
_LOOKS = frozenset({"asset", "texture", "material", "mesh", "camera", "light", "visual", "statistic"})
"""Elements that cannot change the physics."""


def package_root() -> Path:
    """The folder of hf-libero's `libero.libero`, found without importing it.

    Raises:
        SimulatorError: hf-libero is not installed.
    """
    spec = importlib.util.find_spec("libero")
    if spec is None or not spec.submodule_search_locations:
        raise SimulatorError(f"LIBERO is not installed. Install it with: {install_command('libero')}")
    return Path(next(iter(spec.submodule_search_locations))) / "libero"


def find_assets(option: str | None = None, *, download: bool = True) -> Path:
    """The folder with LIBERO's meshes, textures and object models.

    In order: the option, `$ROBORECOVER_LIBERO_ASSETS`, the `assets:` key of LIBERO's own `config.yaml`, the
    installed package's `assets`, `~/.cache/libero/assets`, and then the Hub, into that last folder. The first
    two are orders: a folder named there must be complete. The others are used only if they are.

    Args:
        option: the user's choice; None looks further.
        download: whether the Hub may be asked; never when `HF_HUB_OFFLINE` is set.

    Raises:
        SimulatorError: there is no complete folder; says what is missing and what to set.
    """
    for label, value in (("assets_dir", option), (f"${ASSETS_VARIABLE}", os.environ.get(ASSETS_VARIABLE))):
        if value:
            folder = Path(value).expanduser()
            if problem := missing_asset(folder):
                raise SimulatorError(
                    f"{label} names {folder}, which is not a complete LIBERO asset folder: {problem}. "
                    f"Point it at a download of {HUB_REPOSITORY}"
                )
            return folder.resolve()
    cache = Path("~/.cache/libero/assets").expanduser()
    tried = []
    for folder in (*_configured(), package_root() / "assets", cache):
        problem = missing_asset(folder)
        if not problem:
            return folder.resolve()
        tried.append(f"{folder} ({problem})")
    offline = os.environ.get("HF_HUB_OFFLINE", "").lower() in {"1", "true", "yes", "on"}
    failure = (
        "the Hub was not asked because HF_HUB_OFFLINE is set" if offline else "downloading was not allowed"
    )
    if download and not offline:
        failure = _download(cache)
        if not failure:
            return cache.resolve()
    raise SimulatorError(
        f"LIBERO's assets are not on this machine: looked at {'; '.join(tried)}; {failure}. Set "
        f"--env.assets_dir or ${ASSETS_VARIABLE} to a folder that holds them, or download them with: "
        f"hf download {HUB_REPOSITORY} --repo-type dataset --revision {HUB_REVISION} --local-dir {cache}"
    )


def missing_asset(folder: Path) -> str:
    """The first thing that keeps a folder from being complete, in words; empty if nothing does."""
    if not folder.is_dir():
        return "no such folder"
    needed = [folder / "textures" / f"{name}.png" for name in _TEXTURES.split()]
    for model in _models(folder):
        if not model.is_file():
            return f"no {model.relative_to(folder)}"
        needed += [model.parent / name for name in _used_files(ET.parse(model).getroot())]
    for path in needed:
        if not path.is_file():
            return f"no {os.path.normpath(path.relative_to(folder))}"
    return ""


def physics_hash(folder: Path) -> str:
    """Twelve hex digits over whatever in the assets decides the physics and the success predicates.

    Bodies, joints, sites and colliding geoms with their meshes, of every model that the forty tasks load.
    Textures, materials and visual meshes are left out: they change pixels, not physics.
    """
    digest = hashlib.sha256()
    for path in _models(folder):
        root = ET.parse(path).getroot()
        meshes = {m.get("name"): m for m in root.iter("mesh")}
        digest.update(path.name.encode())
        for depth, element in _walk(root):
            if element.tag == "geom" and element.get("group") == "1":
                continue
            attributes = {
                k: " ".join(v.split()) for k, v in element.attrib.items() if k not in {"rgba", "material"}
            }
            digest.update(f"{depth} {element.tag} {sorted(attributes.items())}".encode())
            mesh = meshes.get(element.get("mesh")) if element.tag == "geom" else None
            if mesh is not None:
                digest.update(f"{mesh.get('scale')}".encode())
                digest.update((path.parent / mesh.get("file", "")).read_bytes())
    return digest.hexdigest()[:12]


def quiet_import(assets: Path) -> None:
    """Imports `libero.libero` without a prompt and points it at the assets; affects this process alone."""
    folder = Path(os.environ.get("LIBERO_CONFIG_PATH") or "~/.libero").expanduser()
    if not (folder / "config.yaml").is_file():
        os.environ["LIBERO_CONFIG_PATH"] = str(_private_config(assets))
    import libero.libero

    libero.libero._assets_path_cache = str(assets)  # what get_assets_path() looks at first


def _models(folder: Path) -> list[Path]:
    return [folder / pattern.format(name) for pattern, names in _MODELS.items() for name in names.split()]


def _used_files(root: ET.Element) -> Iterator[str]:
    """Mesh and texture files that some geom of a model shows; models also name files that nothing uses."""
    geoms = list(root.iter("geom"))
    meshes = {geom.get("mesh") for geom in geoms}
    materials = {geom.get("material") for geom in geoms}
    textures = {m.get("texture") for m in root.iter("material") if m.get("name") in materials}
    for tag, used in (("mesh", meshes), ("texture", textures)):
        for element in root.iter(tag):
            file = element.get("file", "")
            # Scenes name walls and floors in ../textures that LIBERO replaces by those of _TEXTURES.
            if file and element.get("name") in used and "../textures/" not in file:
                yield file


def _walk(root: ET.Element, depth: int = 0) -> Iterator[tuple[int, ET.Element]]:
    """Elements in document order with their depth, those that only decide looks left out."""
    for child in root:
        if child.tag not in _LOOKS:
            yield depth, child
            yield from _walk(child, depth + 1)


def _configured() -> list[Path]:
    """The asset folder that LIBERO's own config.yaml names, if any."""
    path = Path(os.environ.get("LIBERO_CONFIG_PATH") or "~/.libero").expanduser() / "config.yaml"
    try:
        match = re.search(r"^assets:\s*['\"]?(.+?)['\"]?\s*$", path.read_text(encoding="utf-8"), re.MULTILINE)
    except OSError:
        return []
    return [Path(match[1]).expanduser()] if match else []


def cache_folder() -> Path:
    """Of what can be made again; it need not exist."""
    return Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "roborecover"


def _private_config(assets: Path) -> Path:
    """A folder with a config.yaml for LIBERO's import, shared by all processes that use the same packages."""
    root = package_root()
    text = "".join(
        f"{key}: {value}\n"
        for key, value in {
            "assets": assets,
            "bddl_files": root / "bddl_files",
            "benchmark_root": root,
            "datasets": root.parent / "datasets",
            "init_states": root / "init_files",
        }.items()
    )
    name = f"libero-{hashlib.sha256(text.encode()).hexdigest()[:12]}"
    folder = cache_folder() / name
    try:
        atomic_write(folder / "config.yaml", text)
    except OSError:  # no writable home, as in some containers
        folder = _own_config().path
        atomic_write(folder / "config.yaml", text)
    return folder


@cache
def _own_config() -> TemporaryFolder:
    """A folder of this process alone, for as long as it lives."""
    return TemporaryFolder("libero")


def _download(folder: Path) -> str:
    """Fetches the assets from the Hub; returns what went wrong, in words, or nothing."""
    import httpx
    from huggingface_hub import snapshot_download

    try:
        snapshot_download(HUB_REPOSITORY, repo_type="dataset", revision=HUB_REVISION, local_dir=folder)
    except (OSError, ValueError, httpx.HTTPError) as err:  # the Hub's own errors are httpx's
        return (
            f"downloading {HUB_REPOSITORY} failed ({' '.join(str(err).split())[:200] or type(err).__name__})"
        )
    problem = missing_asset(folder)
    return f"the download is incomplete: {problem}" if problem else ""
