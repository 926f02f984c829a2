# Sourced by tools/demo, tools/test and tools/bench: makes or reuses the environment in .venv.
# Needs only Python 3.11 with venv and pip. PMAC_COMP_PYTHON names another interpreter.

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
venv="$root/.venv"

say() { printf '== %s\n' "$*"; }
fail() { printf 'error: %s\n' "$*" >&2; exit 2; }

find_python() {
    local candidate
    for candidate in "${PMAC_COMP_PYTHON:-}" python3.11 python3 python; do
        [ -n "$candidate" ] || continue
        if "$candidate" -c 'import sys; sys.exit(sys.version_info[:2] != (3, 11))' 2>/dev/null; then
            printf '%s' "$candidate"
            return
        fi
    done
    fail "Python 3.11 was not found. Install it, or set PMAC_COMP_PYTHON to its path."
}

# ensure_environment EXTRAS: installs the project with the versions of tools/constraints.txt.
ensure_environment() {
    local extras=$1 python stamp wanted
    stamp="$venv/.installed-$extras"
    wanted=$(cat "$root/pyproject.toml" "$root/tools/constraints.txt" | cksum)
    if [ -x "$venv/bin/python" ] && [ "$(cat "$stamp" 2>/dev/null)" = "$wanted" ]; then
        say "environment: reusing .venv"
        return
    fi
    python=$(find_python) || exit 2
    if ! [ -x "$venv/bin/python" ]; then
        say "environment: creating .venv with $("$python" --version)"
        "$python" -m venv "$venv" \
            || fail "the module venv does not work; on Debian install python3.11-venv."
    fi
    say "environment: installing pmac-comp[$extras] (some minutes the first time)"
    "$venv/bin/python" -m pip install --quiet --quiet --disable-pip-version-check \
        --constraint "$root/tools/constraints.txt" --editable "$root[$extras]" \
        || fail "pip could not install the packages; check the connection to the package index."
    printf '%s' "$wanted" > "$stamp"
}
