#!/usr/bin/env bash
# Builds the Debian package emp-server from the release binaries of this checkout.
#
#   packaging/debian/build.sh [FOLDER]      writes FOLDER/emp-server_VERSION_ARCH.deb (default: target/packages)
#
# Needs dpkg-dev, and MuJoCo as `cargo xtask setup` fetches it. Robots and weights are those that git tracks, so that a fetched
# model never gets into the package.
set -euo pipefail
cd "$(git rev-parse --show-toplevel)"
out=$(realpath -m "${1:-target/packages}")
target=${CARGO_TARGET_DIR:-target}
version=$(sed -n 's/^version = "\(.*\)"/\1/p' Cargo.toml | head -1)
architecture=$(dpkg --print-architecture)

[ -n "${EMP_SKIP_BUILD:-}" ] || cargo build --release -p emp-server -p emp-client

root=$(mktemp -d)
trap 'rm -rf "$root"' EXIT
chmod 755 "$root"
home=$root/usr/lib/emp-server
install -D -m755 -s "$target/release/emp-server" "$home/bin/emp-server"
install -D -m755 -s "$target/release/emp" "$root/usr/bin/emp"
ln -s ../lib/emp-server/bin/emp-server "$root/usr/bin/emp-server"
# Where the executable looks for it, from its own folder.
mujoco=$(ldd "$target/release/emp-server" | sed -n 's/.*libmujoco[^ ]* => \([^ ]*\).*/\1/p')
install -D -m644 -s "$mujoco" "$home/.mujoco/lib/$(basename "$mujoco")"

data=$root/usr/share/emp-server
git ls-files robots models/weights | while read -r file; do
    install -D -m644 "$file" "$data/${file#models/}"
done
install -D -m644 packaging/debian/server.toml "$root/etc/emp-server/server.toml"
install -D -m644 packaging/debian/emp-server.service "$root/lib/systemd/system/emp-server.service"
for file in packaging/monitoring/*; do install -D -m644 "$file" "$data/monitoring/$(basename "$file")"; done

doc=$root/usr/share/doc/emp-server
install -D -m644 packaging/debian/copyright "$doc/copyright"
for file in docs/security.md docs/operations.md; do install -D -m644 "$file" "$doc/$(basename "$file")"; done
printf 'emp-server (%s) unstable; urgency=medium\n\n  * See the history of the repository.\n\n -- EMP <emp@localhost>  %s\n' \
    "$version" "$(git log -1 --format=%cD)" | gzip -9n > "$doc/changelog.gz"

control=$root/DEBIAN
mkdir -p "$control"
install -m755 packaging/debian/{postinst,prerm,postrm} "$control/"
echo /etc/emp-server/server.toml > "$control/conffiles"
scratch=$(mktemp -d)
mkdir "$scratch/debian"
printf 'Source: emp-server\nPackage: emp-server\n' > "$scratch/debian/control"
depends=$(cd "$scratch" && dpkg-shlibdeps -O --ignore-missing-info -l"$home/.mujoco/lib" \
    -e"$home/bin/emp-server" -e"$root/usr/bin/emp" 2>/dev/null | sed -n 's/^shlibs:Depends=//p')
rm -rf "$scratch"
cat > "$control/control" <<END
Package: emp-server
Version: $version
Architecture: $architecture
Maintainer: EMP <emp@localhost>
Depends: ${depends:+$depends, }passwd
Suggests: ca-certificates
Section: science
Priority: optional
Installed-Size: $(du -sk "$root" | cut -f1)
Description: motion filtering for humanoid robots, as a service
 Turns a person's motion into joint targets for a humanoid robot, changes
 them as far as balance needs, and its state into leg targets, over gRPC.
 This package has the server, the command emp, the weights and the robots.
END

mkdir -p "$out"
package=$out/emp-server_${version}_$architecture.deb
dpkg-deb --root-owner-group --build "$root" "$package" >/dev/null
echo "$package"
