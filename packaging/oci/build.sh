#!/usr/bin/env bash
# Builds an OCI image of the Debian package on Debian itself: no registry, no base image of others.
#
#   packaging/oci/build.sh PACKAGE.deb [FOLDER]      writes the image FOLDER:VERSION (default: target/packages/emp-server)
#
# Needs mmdebstrap and umoci. MIRROR (without it mmdebstrap chooses) and SUITE choose the Debian; where mirrors or their certificates are unusual, MMDEBSTRAP_OPTIONS
# is passed on. Copy the image into a registry with `skopeo copy oci:FOLDER:VERSION docker://…`.
set -euo pipefail
package=$(realpath "$1")
image=$(realpath -m "${2:-target/packages/emp-server}")
suite=${SUITE:-bookworm}
version=$(dpkg-deb -f "$package" Version)

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
# shellcheck disable=SC2086
mmdebstrap --variant=essential --include="ca-certificates,$package" \
    --dpkgopt='path-exclude=/usr/share/man/*' --dpkgopt='path-exclude=/usr/share/locale/*' \
    ${MMDEBSTRAP_OPTIONS:-} "$suite" "$work/root.tar" ${MIRROR:+"$MIRROR"}
mkdir "$work/root"
tar -C "$work/root" --exclude='./dev/*' -xf "$work/root.tar"

rm -rf "$image"
mkdir -p "$(dirname "$image")"
umoci init --layout "$image"
umoci new --image "$image:$version"
umoci insert --image "$image:$version" "$work/root" /
user=$(sed -n 's/^emp-server:x:\([0-9]*\):\([0-9]*\):.*/\1:\2/p' "$work/root/etc/passwd")
umoci config --image "$image:$version" \
    --config.user "$user" \
    --config.entrypoint /usr/bin/emp-server \
    --config.cmd --config --config.cmd /etc/emp-server/server.toml \
    --config.exposedports 50051/tcp \
    --config.stopsignal SIGTERM \
    --config.label org.opencontainers.image.title=emp-server \
    --config.label "org.opencontainers.image.version=$version"
echo "$image:$version"
