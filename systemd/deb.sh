#!/bin/sh
# Builds a Debian package of the daemon, for this machine or another: its virtual environment, unit, rules and
# configuration. The same tree as install.sh lays down, at the places that Debian gives to packages.
set -eu

usage() {
    cat <<'TEXT'
usage: deb.sh [OPTION...]

options:
  --output DIR     where the package goes (default: build)
  --extras LIST    extras of the package, such as fast,record,mqtt (default: record,mqtt)
  --python PYTHON  the interpreter of the system that the package is for (default: /usr/bin/python3)
  --arch ARCH      the machine that the package is for: amd64 or arm64 (default: this one)
  --help           this text

Prints the package's path. exit code: 0 done; 1 something failed; 2 wrong use
TEXT
}

fail() { echo "deb.sh: $*" >&2; exit 1; }
misuse() { echo "deb.sh: $*" >&2; usage >&2; exit 2; }

OUTPUT=build EXTRAS=record,mqtt PYTHON=/usr/bin/python3 ARCHITECTURE=
while [ $# -gt 0 ]; do
    case $1 in
        --output | --extras | --python | --arch)
            [ $# -gt 1 ] || misuse "$1 needs a value"
            case $1 in --output) OUTPUT=$2 ;; --extras) EXTRAS=$2 ;; --python) PYTHON=$2 ;; --arch) ARCHITECTURE=$2 ;; esac
            shift ;;
        -h | --help) usage; exit 0 ;;
        *) misuse "unknown: $1" ;;
    esac
    shift
done

command -v dpkg-deb > /dev/null || fail "dpkg-deb is missing: this is no Debian"
"$PYTHON" -c 'import ensurepip' 2> /dev/null || fail "$PYTHON has no venv: apt install python3-venv"
NAME=arm-companion
SOURCE=$(CDPATH='' cd -- "$(dirname -- "$0")/.." && pwd)
VERSION=$(sed -n 's/^version = "\(.*\)"$/\1/p' "$SOURCE/pyproject.toml")
HERE=$(dpkg --print-architecture)
case ${ARCHITECTURE:=$HERE} in
    "$HERE") MACHINE= ;;
    amd64) MACHINE=x86_64 ;;
    arm64) MACHINE=aarch64 ;;
    *) misuse "--arch $ARCHITECTURE: amd64 or arm64" ;;
esac
MINOR=$("$PYTHON" -c 'import sys; print(sys.version_info.minor)')
TREE=$(mktemp -d)
trap 'rm -rf "$TREE"' EXIT
chmod 0755 "$TREE"

"$SOURCE/systemd/install.sh" --root "$TREE" --source "$SOURCE" --extras "$EXTRAS" --python "$PYTHON" \
    ${MACHINE:+--machine "$MACHINE"} >&2

# from where an administrator puts things to where a package does; systemd makes what lies below /var by itself
move() { mkdir -p "$TREE/$(dirname "$2")" && mv "$TREE/$1" "$TREE/$2"; }
move etc/systemd/system/$NAME.service lib/systemd/system/$NAME.service
move etc/udev/rules.d/99-$NAME.rules lib/udev/rules.d/60-$NAME.rules
move etc/sysusers.d/$NAME.conf usr/lib/sysusers.d/$NAME.conf
move usr/local/bin/$NAME usr/bin/$NAME
rm -rf "$TREE/var" "$TREE/usr/local"
find "$TREE/etc" -mindepth 1 -maxdepth 1 ! -name $NAME -exec rm -rf {} +
# nothing that names the folder it was built in, and nothing that only serves people at a prompt
VENV=$TREE/opt/$NAME/venv
rm -f "$VENV"/bin/[aA]ctivate* "$VENV"/bin/pip* "$VENV"/lib/python3.*/site-packages/arm_companion-*.dist-info/direct_url.json
rm -rf "$VENV"/lib/python3.*/site-packages/pip "$VENV"/lib/python3.*/site-packages/pip-*.dist-info \
    "$VENV"/lib/python3.*/site-packages/setuptools* "$VENV"/lib/python3.*/site-packages/_distutils_hack \
    "$VENV"/lib/python3.*/site-packages/pkg_resources "$VENV"/lib/python3.*/site-packages/distutils-precedence.pth
sed -i '/^command = /d' "$VENV/pyvenv.cfg"
find "$TREE" -name __pycache__ -type d -prune -exec rm -rf {} +
if grep -rIlF "$TREE" "$TREE" >&2; then fail "the files above name the folder that the package was built in"; fi
mkdir -p "$TREE/usr/share/doc/$NAME" "$TREE/DEBIAN"
cp "$SOURCE/LICENSE" "$TREE/usr/share/doc/$NAME/copyright"

cat > "$TREE/DEBIAN/control" <<CONTROL
Package: $NAME
Version: $VERSION
Architecture: $ARCHITECTURE
Section: misc
Priority: optional
Maintainer: the authors of arm_companion <arm-companion@localhost>
Installed-Size: $(du -sk "$TREE" | cut -f1)
Depends: python3 (>= 3.$MINOR), python3 (<< 3.$((MINOR + 1))), systemd
Description: continuum arm on a drone: MAVLink companion service
 A daemon for a drone's companion computer that runs the perching and grasping
 of a tendon-driven continuum arm beside PX4 or ArduPilot. The service is
 enabled and not started: configure it first.
CONTROL
echo "/etc/$NAME/config.toml" > "$TREE/DEBIAN/conffiles"

cat > "$TREE/DEBIAN/postinst" <<'SCRIPT'
#!/bin/sh
set -e
[ "$1" = configure ] || exit 0
systemd-sysusers arm-companion.conf
if [ -d /run/systemd/system ]; then
    systemctl daemon-reload
    udevadm control --reload || true
    udevadm trigger --subsystem-match=usb-serial --subsystem-match=tty || true
fi
if [ -z "$2" ]; then
    systemctl enable --quiet arm-companion.service
    echo "edit /etc/arm-companion/config.toml, then: arm-companion doctor"
elif [ -d /run/systemd/system ]; then
    systemctl try-restart arm-companion.service
fi
SCRIPT
cat > "$TREE/DEBIAN/prerm" <<'SCRIPT'
#!/bin/sh
set -e
# an upgrade leaves the arm holding what it holds until postinst starts the new daemon in the place of the old
[ "$1" = remove ] || exit 0
if [ -d /run/systemd/system ]; then systemctl stop arm-companion.service; fi
systemctl disable --quiet arm-companion.service
SCRIPT
cat > "$TREE/DEBIAN/postrm" <<'SCRIPT'
#!/bin/sh
set -e
if [ -d /run/systemd/system ]; then systemctl daemon-reload; fi
if [ "$1" = purge ]; then
    rm -rf /var/lib/arm-companion /var/log/arm-companion /var/cache/arm-companion /etc/arm-companion
fi
# byte code that root's calls left behind
if [ "$1" = remove ] || [ "$1" = purge ]; then rm -rf /opt/arm-companion; fi
SCRIPT
chmod 0755 "$TREE/DEBIAN/postinst" "$TREE/DEBIAN/prerm" "$TREE/DEBIAN/postrm"

mkdir -p "$OUTPUT"
PACKAGE=$OUTPUT/${NAME}_${VERSION}_$ARCHITECTURE.deb
dpkg-deb --root-owner-group -Zxz --build "$TREE" "$PACKAGE" >&2
echo "$PACKAGE"
