#!/bin/sh
# A Debian package of a bundle: deploy/deb/build.sh BUNDLE.tar PUBLIC_KEY [FOLDER=dist]
# It carries the bundle and the key, and installs or updates with them; what it installs lies in /opt/timberhand and is not
# dpkg's.  The same bundle gives the same bytes.
# Exit status: 2 usage, 3 a tool is missing.
set -eu

bundle=${1-} key=${2-} out=${3:-dist}
if [ ! -f "$bundle" ] || [ ! -f "$key" ]; then
    echo "deb: name a bundle (make bundle) and the public key of its signer: deploy/deb/build.sh BUNDLE.tar PUBLIC_KEY" >&2
    exit 2
fi
command -v dpkg-deb >/dev/null || {
    echo "deb: dpkg-deb is missing; build the package on Debian or a relative" >&2
    exit 3
}
here=$(CDPATH='' cd -- "$(dirname -- "$0")" && pwd)
name=$(basename "$bundle" .tar)
version=${name#timberhand-}
tree=$(mktemp -d)
trap 'rm -rf "$tree"' EXIT
umask 022

share=$tree/usr/share/timberhand
mkdir -p "$share/bundle" "$tree/DEBIAN"
tar -xf "$bundle" -C "$share/bundle" --strip-components=1 --no-same-owner
cp "$key" "$share/signer.pem"
case $(sed -n 's/.*"machine": "\(.*\)".*/\1/p' "$share/bundle/release.json") in
x86_64) architecture=amd64 ;;
aarch64) architecture=arm64 ;;
*)
    echo "deb: $bundle does not say for which processor it is; make it again: make bundle" >&2
    exit 2
    ;;
esac
sed -e "s/@VERSION@/$version/" -e "s/@ARCHITECTURE@/$architecture/" "$here/control" >"$tree/DEBIAN/control"
for script in postinst prerm; do install -m 0755 "$here/$script" "$tree/DEBIAN/$script"; done
(cd "$tree" && find usr -type f -exec md5sum {} + | sort -k 2 >DEBIAN/md5sums)
chmod -R u=rwX,go=rX "$tree"
mkdir -p "$out"
# A time of its own in every file would make every package another one.
export SOURCE_DATE_EPOCH=315532800
find "$tree" -exec touch --no-dereference --date="@$SOURCE_DATE_EPOCH" {} +
dpkg-deb --root-owner-group -Znone --build "$tree" "$out/timberhand_${version}_$architecture.deb" >/dev/null
echo "$out/timberhand_${version}_$architecture.deb"
