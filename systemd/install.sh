#!/bin/sh
# Installs arm_companion as a system service, upgrades it, or takes it away. Asks nothing; a second run changes nothing.
set -eu

usage() {
    cat <<'TEXT'
usage: install.sh [ACTION] [OPTION...]

actions:
  install      user, groups, udev rules, directories, configuration, virtual environment, unit (default)
  upgrade      the same, then restart the service if it runs
  uninstall    take away unit, rules and virtual environment; configuration, state and logs stay

options:
  --source DIR     the checkout to install from (default: the one this script is in)
  --extras LIST    extras of the package, such as fast,record,mqtt (default: fast,record)
  --python PYTHON  the interpreter that the virtual environment is made with (default: python3)
  --root DIR       install below DIR, touching nothing else; DESTDIR does the same
  --machine NAME   with --root: for another kind of machine, aarch64 or x86_64, from ready-made packages alone;
                   --python is then one of the target's version, at the path that it has there
  --no-venv        leave the virtual environment alone
  --start          start the service at the end (and at each boot it starts anyway)
  --purge          with uninstall: configuration, state, logs and user go too
  --dry-run        show what would be done, and do nothing
  --help           this text

exit code: 0 done; 1 something failed; 2 wrong use
TEXT
}

fail() { echo "install.sh: $*" >&2; exit 1; }
misuse() { echo "install.sh: $*" >&2; usage >&2; exit 2; }

ACTION=install ROOT=${DESTDIR:-} DRY= START= PURGE= VENV=yes EXTRAS=fast,record PYTHON=python3 MACHINE=
SOURCE=$(CDPATH='' cd -- "$(dirname -- "$0")/.." && pwd)
while [ $# -gt 0 ]; do
    case $1 in
        install | upgrade | uninstall) ACTION=$1 ;;
        --source | --extras | --python | --root | --machine)
            [ $# -gt 1 ] || misuse "$1 needs a value"
            case $1 in
                --source) SOURCE=$2 ;; --extras) EXTRAS=$2 ;; --python) PYTHON=$2 ;; --root) ROOT=$2 ;;
                --machine) MACHINE=$2 ;;
            esac
            shift ;;
        --no-venv) VENV= ;;
        --start) START=yes ;;
        --purge) PURGE=yes ;;
        --dry-run) DRY=yes ;;
        -h | --help) usage; exit 0 ;;
        *) misuse "unknown: $1" ;;
    esac
    shift
done
[ -z "$PURGE" ] || [ "$ACTION" = uninstall ] || misuse "--purge goes with uninstall"
case $ROOT in
    '' | /) ROOT= ;;
    /*) ROOT=${ROOT%/} ;;
    *) ROOT=$(pwd)/${ROOT%/} ;;
esac
# lists of directories below and pip's own scripts are split at blanks: something else would be removed
case $ROOT in *[[:space:]]* | *[*?[]*) misuse "--root $ROOT: a path without blanks and wildcards" ;; esac
case $MACHINE in
    '') ;;
    aarch64 | x86_64) [ -n "$ROOT" ] || misuse "--machine goes with --root" ;;
    *) misuse "--machine $MACHINE: aarch64 or x86_64" ;;
esac

NAME=arm-companion
PREFIX=$ROOT/opt/$NAME
ETC=$ROOT/etc/$NAME
UNIT=$ROOT/etc/systemd/system/$NAME.service
RULES=$ROOT/etc/udev/rules.d/99-$NAME.rules
USERS=$ROOT/etc/sysusers.d/$NAME.conf
COMMAND=$ROOT/usr/local/bin/$NAME
OWN="$ROOT/var/lib/$NAME $ROOT/var/log/$NAME $ROOT/var/cache/$NAME"

say() { printf '%-10s %s\n' "$1" "$2"; }

# do WORDS...: run them, or only tell
do_() {
    if [ -n "$DRY" ]; then say would "$*"; else "$@"; fi
}

# Whether the running system is meant, and runs under systemd
alive() { [ -z "$ROOT" ] && [ -d /run/systemd/system ]; }

# put FILE TARGET MODE: copy, unless the same is there
put() {
    if cmp -s "$1" "$2"; then
        say unchanged "$2"
        return 1
    fi
    say write "$2"
    do_ install -D -m "$3" "$1" "$2"
}

take_away() {
    for path in "$@"; do
        if [ -e "$path" ] || [ -L "$path" ]; then
            say remove "$path"
            do_ rm -rf -- "$path"
        fi
    done
}

# The user's number in the tree that is installed to; empty: none yet
user_id() { sed -n "s/^$NAME:[^:]*:\([0-9]*\):\([0-9]*\):.*/\1:\2/p" "$ROOT/etc/passwd" 2>/dev/null || true; }

make_user() {
    if [ -n "$(user_id)" ] && grep -q "^dialout:.*[:,]$NAME\(,\|$\)" "$ROOT/etc/group" 2>/dev/null; then
        say unchanged "user $NAME"
    elif [ -n "$ROOT" ] && [ "$(id -u)" != 0 ]; then
        say later "user $NAME: systemd-sysusers makes it from $USERS at boot"
    elif command -v systemd-sysusers >/dev/null; then
        say make "user $NAME, in group dialout"
        do_ systemd-sysusers ${ROOT:+--root="$ROOT"} "$USERS"
    elif [ -n "$ROOT" ]; then
        say later "user $NAME: systemd-sysusers makes it from $USERS at boot"
    else
        say make "user $NAME, in group dialout"
        do_ groupadd --system --force dialout
        [ -n "$(user_id)" ] ||
            do_ useradd --system --user-group --no-create-home --home-dir /var/lib/$NAME --shell /usr/sbin/nologin $NAME
        do_ usermod --append --groups dialout $NAME
    fi
}

make_directories() {
    for directory in $OWN; do
        if [ -d "$directory" ]; then
            say unchanged "$directory"
            continue
        fi
        say make "$directory"
        do_ install -d -m 0750 "$directory"
        owner=$(user_id)
        # who is not root may stage a tree, in which everything is his
        if [ -n "$owner" ] && [ "$(id -u)" = 0 ]; then do_ chown "$owner" "$directory"; fi
    done
}

make_configuration() {
    if [ -e "$ETC/config.toml" ]; then
        say kept "$ETC/config.toml"
    else
        say write "$ETC/config.toml"
        do_ install -D -m 0644 "$SOURCE/systemd/config.toml" "$ETC/config.toml"
    fi
}

# Fill the virtual environment for a machine whose programs do not run here: nothing of it is run, or compiled.
fill_for_another_machine() {
    version=$("$PYTHON" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
    site=$PREFIX/venv/lib/python$version/site-packages
    if [ -n "$DRY" ]; then
        say would "pip install --only-binary=:all: --platform manylinux*_$MACHINE --target $site"
        return 0
    fi
    scratch=$(mktemp -d)
    "$PYTHON" -m venv "$scratch/venv"
    pip() { "$scratch/venv/bin/python" -m pip --disable-pip-version-check --quiet "$@"; }
    pip wheel --no-deps --wheel-dir "$scratch" "$SOURCE"
    rm -rf "$site" && mkdir -p "$site"
    wheel=$(echo "$scratch"/arm_companion-*.whl)
    set -- --only-binary=:all: --python-version "$version" --target "$site" --no-compile
    for libc in 2_17 2_24 2_26 2_27 2_28; do set -- "$@" --platform "manylinux_${libc}_$MACHINE"; done
    pip install "$@" --platform "manylinux2014_$MACHINE" -c "$SOURCE/constraints.txt" "$wheel${EXTRAS:+[$EXTRAS]}"
    rm -rf "$scratch" "$site/bin"
    cat > "$PREFIX/venv/bin/$NAME" <<SCRIPT
#!$PREFIX/venv/bin/python
import sys
from arm_companion.__main__ import main
sys.exit(main())
SCRIPT
    chmod 0755 "$PREFIX/venv/bin/$NAME"
}

make_venv() {
    [ -n "$VENV" ] || { say skipped "$PREFIX/venv"; return 0; }
    "$PYTHON" -c 'import sys; sys.exit(sys.version_info < (3, 11))' || fail "$PYTHON is not Python 3.11 or newer"
    if [ ! -x "$PREFIX/venv/bin/python" ]; then
        say make "$PREFIX/venv"
        do_ "$PYTHON" -m venv ${MACHINE:+--without-pip} "$PREFIX/venv"
    fi
    say install "$SOURCE${EXTRAS:+ [$EXTRAS]}${MACHINE:+ for $MACHINE}"
    if [ -n "$MACHINE" ]; then
        fill_for_another_machine
    else
        do_ "$PREFIX/venv/bin/python" -m pip --disable-pip-version-check --quiet install --upgrade \
            -c "$SOURCE/constraints.txt" "$SOURCE${EXTRAS:+[$EXTRAS]}"
    fi
    if [ -n "$ROOT" ] && [ -z "$DRY" ]; then
        # scripts name their interpreter by its path, which is another once the tree stands where it belongs
        grep -lI "^#!$PREFIX" "$PREFIX/venv/bin/"* | while read -r script; do
            sed -i "1s|^#!$ROOT|#!|" "$script"
        done
    fi
    if [ ! -L "$COMMAND" ]; then
        say link "$COMMAND"
        do_ mkdir -p "$ROOT/usr/local/bin"
        do_ ln -s "/opt/$NAME/venv/bin/$NAME" "$COMMAND"
    fi
}

# Compiled mechanics, as the user that will load them; without numba there are none
warm() {
    case ",$EXTRAS," in *,fast,*) ;; *) return 0 ;; esac
    [ -n "$VENV" ] && [ -z "$ROOT" ] && command -v runuser >/dev/null || return 0
    say compile "mechanics, into /var/cache/$NAME"
    do_ runuser -u $NAME -- env NUMBA_CACHE_DIR=/var/cache/$NAME "$PREFIX/venv/bin/$NAME" model warm ||
        say warning "mechanics are not compiled: the daemon flies on NumPy"
}

install_() {
    [ -f "$SOURCE/pyproject.toml" ] || fail "$SOURCE is no checkout of arm_companion: --source"
    put "$SOURCE/systemd/$NAME.sysusers" "$USERS" 0644 || true
    make_user
    make_directories
    make_configuration
    make_venv
    warm
    if put "$SOURCE/systemd/99-$NAME.rules" "$RULES" 0644 && alive; then
        do_ udevadm control --reload
        do_ udevadm trigger --subsystem-match=usb-serial --subsystem-match=tty
    fi
    if put "$SOURCE/systemd/$NAME.service" "$UNIT" 0644 && alive; then do_ systemctl daemon-reload; fi
    WANTED=$ROOT/etc/systemd/system/multi-user.target.wants/$NAME.service
    if [ -L "$WANTED" ]; then
        say unchanged "$WANTED"
    else
        say enable "$NAME.service"
        do_ mkdir -p "$(dirname "$WANTED")"
        do_ ln -s "/etc/systemd/system/$NAME.service" "$WANTED"
        if alive; then do_ systemctl daemon-reload; fi
    fi
    if alive; then
        if [ "$ACTION" = upgrade ]; then do_ systemctl try-restart $NAME; fi
        if [ -n "$START" ]; then do_ systemctl start $NAME; fi
    fi
    say next "edit $ETC/config.toml, then: $NAME doctor"
}

uninstall() {
    if alive; then do_ systemctl disable --now $NAME.service 2>/dev/null || true; fi
    take_away "$ROOT/etc/systemd/system/multi-user.target.wants/$NAME.service" "$UNIT" "$RULES" "$USERS" "$COMMAND" \
        "$PREFIX"
    if alive; then
        do_ systemctl daemon-reload
        do_ udevadm control --reload
    fi
    if [ -n "$PURGE" ]; then
        # shellcheck disable=SC2086 # a list of directories without blanks
        take_away "$ETC" $OWN
        if [ -z "$ROOT" ] && [ -n "$(user_id)" ]; then do_ userdel $NAME; fi
    else
        say kept "$ETC, $OWN"
    fi
}

if [ -z "$ROOT" ] && [ -z "$DRY" ] && [ "$(id -u)" != 0 ]; then fail "run it as root, or with --root DIR or --dry-run"; fi
case $ACTION in
    uninstall) uninstall ;;
    *) install_ ;;
esac
