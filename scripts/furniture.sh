#!/bin/sh
# Fetches Debian's package sweethome3d-furniture (about 120 MB; CC0 and CC BY 3.0) and unpacks its models into a folder for
# `--library`. Needs apt-get or a downloaded package, dpkg-deb, and unzip or python3.
#
#   scripts/furniture.sh DIR [PACKAGE.deb]
set -eu

if [ $# -lt 1 ] || [ $# -gt 2 ]; then
    echo "usage: $0 DIR [PACKAGE.deb]" >&2
    exit 2
fi
target=$1
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

if [ $# -eq 2 ]; then
    package=$2
else
    (cd "$work" && apt-get download sweethome3d-furniture)
    package=$(echo "$work"/sweethome3d-furniture_*.deb)
fi
dpkg-deb -x "$package" "$work/root"

mkdir -p "$target"
for library in "$work"/root/usr/share/sweethome3d/furniture/*.sh3f; do
    name=$(basename "$library" .sh3f)
    rm -rf "${target:?}/$name"
    mkdir "$target/$name"
    if command -v unzip >/dev/null; then
        unzip -q "$library" -d "$target/$name"
    else
        python3 -m zipfile -e "$library" "$target/$name"
    fi
done
cp "$work/root/usr/share/doc/sweethome3d-furniture/copyright" "$target/copyright"
echo "$(find "$target" -name '*.obj' | wc -l) models in $target"
