#!/usr/bin/env bash
# Software Vulkan for SAPIEN on a machine without a GPU: prints the file that VK_ICD_FILENAMES has to name.
#
#     export VK_ICD_FILENAMES="$(scripts/vulkan.sh)"
#
# SAPIEN needs Mesa 25 or later. Where the system's is older (Debian 12: 22.3, which fails), the driver of
# bookworm-backports is unpacked in .tools/mesa and nothing is installed: a newer Mesa in the system would also change
# the OpenGL that MuJoCo draws with. apt checks the archive's signature and each package's hash. Needs no root. The libraries it is linked with come with Debian's own
# mesa-vulkan-drivers. Safe to run again.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

say() { printf 'vulkan: %s\n' "$*" >&2; }

tools="$PWD/.tools"
icd="$tools/mesa/lvp_icd.json"
if [[ -f "$icd" ]]; then
    echo "$icd"
    exit 0
fi

version="$(dpkg-query -W -f='${Version}' mesa-vulkan-drivers 2>/dev/null || true)"
if [[ -n "$version" ]] && dpkg --compare-versions "$version" ge 25; then
    ls /usr/share/vulkan/icd.d/lvp_icd*.json | head -n 1
    exit 0
fi

# shellcheck disable=SC1091
[[ -f /etc/os-release ]] && source /etc/os-release
if [[ "${VERSION_CODENAME:-}" != bookworm ]]; then
    say "Mesa 25 or later is needed, here it is ${version:-not installed}; install your system's mesa-vulkan-drivers"
    exit 1
fi
[[ -n "$version" ]] || {
    say "first, as root, for the libraries that the driver needs: apt-get install mesa-vulkan-drivers"
    exit 1
}

mkdir -p "$tools"
echo '*' >"$tools/.gitignore"
apt="$(mktemp -d)"
trap 'rm -rf "$apt"' EXIT
mkdir -p "$apt/lists/partial" "$apt/archives/partial"
# Backports come from the archive that this machine already takes Debian from.
archive="$(apt-get indextargets --format '$(CODENAME) $(REPO_URI)' 'Created-By: Packages' | sed -n 's/^bookworm //p' | head -n 1)"
[[ -n "$archive" ]] || {
    say "apt knows no Debian archive yet; first, as root: apt-get update"
    exit 1
}
echo "deb [signed-by=/usr/share/keyrings/debian-archive-keyring.gpg] $archive bookworm-backports main" \
    >"$apt/sources.list"
options=(-qq -o "Dir::State::lists=$apt/lists" -o "Dir::Cache=$apt" -o "Dir::Etc::sourcelist=$apt/sources.list"
    -o Dir::Etc::sourceparts=- -o APT::Sandbox::User=)
say "fetching Mesa's Vulkan driver from bookworm-backports into .tools/mesa"
(
    cd "$apt"
    apt-get "${options[@]}" update
    apt-get "${options[@]}" download mesa-vulkan-drivers
    dpkg-deb -x mesa-vulkan-drivers_*.deb unpacked
) >&2
library="$(cd "$apt/unpacked" && find usr/lib -name libvulkan_lvp.so)"
mkdir -p "$tools/mesa"
cp "$apt/unpacked/$library" "$tools/mesa/"
printf '{"file_format_version": "1.0.0", "ICD": {"api_version": "1.3.0", "library_path": "%s"}}\n' \
    "$tools/mesa/libvulkan_lvp.so" >"$icd.part"
mv "$icd.part" "$icd"
echo "$icd"
