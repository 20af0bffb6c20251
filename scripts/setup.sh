#!/usr/bin/env bash
# Sets up everything that the package, the demo and the tests need, in .venv inside the clone.
# Safe to run again: does nothing when nothing has changed. With --system only the system's packages, for root;
# with --lerobot-main PATH the same with the LeRobot of a source tree, in .venv-main beside it.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

say() { printf 'setup: %s\n' "$*" >&2; }

# Runs a silent command and says every so often that it is still at work: still WHAT COMMAND [ARGUMENT...]
still() {
    local what="$1" begun=$SECONDS beat status=0
    shift
    # The sleep holds neither the lock nor the output, which a reader would wait for after the end.
    (
        while sleep "${ROBORECOVER_SETUP_EVERY_S:-20}" >/dev/null 2>&1 9>&- && kill -0 "$$" 2>/dev/null; do
            say "still $what ($((SECONDS - begun)) s)"
        done
    ) 9>&- &
    beat=$!
    "$@" || status=$?
    kill "$beat" 2>/dev/null || true
    wait "$beat" 2>/dev/null || true
    return "$status"
}

# OpenGL for MuJoCo (EGL, and OSMesa as its fallback), Vulkan and libX11 for SAPIEN, FFmpeg's libraries for torchcodec,
# Chromium for the tests of pages, and what builds egl_probe, which LIBERO asks for and which has no wheels.
system_packages=(libegl1 libegl-mesa0 libgl1-mesa-dri libosmesa6 mesa-vulkan-drivers libx11-6 ffmpeg chromium git cmake make g++)

case "${1:-}" in
    "" | --system | --lerobot-main) ;;
    -h | --help)
        echo "usage: scripts/setup.sh [--system [PACKAGE...] | --lerobot-main PATH]"
        sed -n '2,4s/^# //p' scripts/setup.sh
        exit 0
        ;;
    *)
        say "unknown option $1: scripts/setup.sh --help"
        exit 2
        ;;
esac

install_system_packages() {
    command -v dpkg-query >/dev/null || {
        say "not Debian or Ubuntu: install OpenGL (EGL or OSMesa), FFmpeg, cmake and a C++ compiler yourself"
        return 0
    }
    local missing=() package
    for package in "$@"; do
        [[ "$(dpkg-query -W -f='${Status}' "$package" 2>/dev/null)" == "install ok installed" ]] || missing+=("$package")
    done
    ((${#missing[@]})) || return 0
    if [[ "$(id -u)" != 0 ]]; then
        say "missing system packages; as root: apt-get install ${missing[*]}"
        return 0
    fi
    say "installing system packages: ${missing[*]}"
    local log known
    log="$(mktemp)"
    for _ in 1 2; do
        apt-get update -qq >"$log" 2>&1 || true
        # One that a distribution has not, such as Ubuntu's Chromium, is not to keep the others out.
        known=()
        for package in "${missing[@]}"; do
            [[ "$(apt-cache policy "$package")" == *"Candidate: "[0-9]* ]] && known+=("$package")
        done
        if ((${#known[@]})) && DEBIAN_FRONTEND=noninteractive \
            apt-get install -y -qq --no-install-recommends "${known[@]}" >>"$log" 2>&1; then
            ((${#known[@]} == ${#missing[@]})) || say "not in this distribution: $(comm -23 \
                <(printf '%s\n' "${missing[@]}" | sort) <(printf '%s\n' "${known[@]}" | sort) | xargs)"
            rm -f "$log"
            return 0
        fi
        sleep 2
    done
    tail -n 5 "$log" >&2
    say "apt-get could not install ${missing[*]} ($log); going on without, 'roborecover doctor' says what is affected"
}

if [[ "${1:-}" == --system ]]; then
    # For machines where only this needs root: sudo scripts/setup.sh --system [PACKAGE...]
    shift
    (($#)) || set -- "${system_packages[@]}"
    install_system_packages "$@"
    exit 0
fi
venv=.venv
if [[ "${1:-}" == --lerobot-main ]]; then
    tree="${2:-}"
    [[ -f "$tree/src/lerobot/__init__.py" && -f "$tree/pyproject.toml" ]] || {
        say "'$tree' is no source tree of LeRobot: give the folder that 'git clone https://github.com/huggingface/lerobot' made"
        exit 1
    }
    venv=.venv-main
fi
# One at a time in a clone: two demos that are started together would install over each other.
if command -v flock >/dev/null; then
    mkdir -p .tools
    echo '*' >.tools/.gitignore
    exec 9>>.tools/setup.lock
    # Status 1: it is held. Any other: the file system has no locks, and setup goes on without.
    status=0
    flock --nonblock 9 2>/dev/null || status=$?
    if ((status == 1)); then
        say "another setup is at work in this clone; waiting for it"
        flock 9
    fi
fi
still "installing system packages" install_system_packages "${system_packages[@]}"
scripts/vulkan.sh >/dev/null || say "no software Vulkan: without a GPU, RoboTwin renders nothing here"

stamp="$venv/.set-up"
# Another file of versions, or /dev/null for the newest that pyproject.toml allows.
constraints="${ROBORECOVER_CONSTRAINTS:-constraints.txt}"
wanted="$(cat pyproject.toml "$constraints" .python-version scripts/setup.sh | sha256sum)"
[[ -z "${tree:-}" ]] || wanted+=" $(cd "$tree" && find pyproject.toml src -name '__pycache__' -prune -o -type f -not -path '*.egg-info/*' -print0 |
    sort -z | xargs -0 cat | sha256sum)"
if [[ -f "$stamp" && "$(cat "$stamp")" == "$wanted" ]] && "$venv/bin/python" -c '' 2>/dev/null; then
    exit 0
fi

uv="$(scripts/uv.sh)"
if ! "$venv/bin/python" -c 'import sys; sys.exit(sys.version_info[:2] != (3, 12))' 2>/dev/null; then
    # The first search stops at a broken interpreter, such as pyenv's stand-in for one that is not installed.
    "$uv" venv --quiet --clear --python 3.12 "$venv" || "$uv" venv --quiet --clear --managed-python --python 3.12 "$venv" || {
        say "no Python 3.12 was found and uv could not fetch one: install Python 3.12 and run this again"
        exit 1
    }
fi
# egl_probe asks for a CMake before 3.5, which CMake 4 refuses to be.
export CMAKE_POLICY_VERSION_MINIMUM="${CMAKE_POLICY_VERSION_MINIMUM:-3.5}"
say "installing Python packages in $venv: 8.4 GB and 3 minutes beside the download, the first time"
install_python_packages() {
    # Compiled once, here: where PYTHONDONTWRITEBYTECODE is set, as in many images, every process would compile all of
    # LeRobot and torch anew, which takes it half a minute.
    "$uv" pip install --quiet --compile-bytecode --python "$venv/bin/python" "${pinned[@]}" -e '.[gym,libero,robotwin,test]'
}
pinned=(-c "$constraints")
if [[ -n "${tree:-}" ]]; then
    # As a wheel: uv would take torch from the index that the tree names. From a copy, so that nothing is built in it.
    copy="$(mktemp -d)"
    trap 'rm -rf "$copy"' EXIT
    mkdir -p "$copy/lerobot"
    (cd "$tree" && cp -r pyproject.toml README.md src "$copy/lerobot" && for name in setup.py MANIFEST.in LICENSE; do
        [[ ! -f "$name" ]] || cp "$name" "$copy/lerobot"
    done)
    "$uv" build --quiet --wheel --out-dir "$copy" "$copy/lerobot"
    grep -v '^lerobot==' "$constraints" >"$copy/constraints.txt" || true
    # An override says all of a requirement, its extras too.
    extras="$("$venv/bin/python" scripts/lerobot_extras.py "$tree")"
    echo "lerobot[$extras] @ file://$(echo "$copy"/lerobot-*.whl)" >"$copy/overrides.txt"
    pinned=(-c "$copy/constraints.txt" --overrides "$copy/overrides.txt")
fi
still "installing Python packages" install_python_packages || {
    sleep 5
    still "installing Python packages, second try" install_python_packages
}
echo "$wanted" >"$stamp"
say "done; 'source $venv/bin/activate' puts roborecover and lerobot-eval on the PATH"
