#!/bin/sh
# Look for weaknesses: deploy/audit.sh [PYTHON=.venv/bin/python]
# bandit: patterns of insecure code, of medium severity or more; one that is as intended says why in its line (nosec).
# pip-audit: weaknesses that are published for the packages of constraints.txt; it asks PyPI, and so needs a network.
# Exit status: 0 nothing found, 3 the tools or the network are missing, 6 something was found.
set -eu

cd "$(dirname "$0")/.."
python=${1:-.venv/bin/python}
"$python" -c 'import bandit, pip_audit' 2>/dev/null || {
    echo "audit: bandit or pip-audit is missing: pip install 'timberhand[audit]'" >&2
    exit 3
}

folders=$(git ls-files '*.py' | grep / | cut -d / -f 1 | sort -u | grep -v -e '^tests$' -e '^docs$')
found=
# shellcheck disable=SC2086 # a list of words
"$python" -m bandit --quiet --severity-level medium --format txt --recursive $folders ||
    found=yes

answer=$(mktemp)
trap 'rm -f "$answer"' EXIT
if "$python" -m pip_audit --requirement constraints.txt --no-deps --disable-pip --strict --progress-spinner off \
    >"$answer" 2>&1; then
    echo "audit: no weakness is published for the packages of constraints.txt"
elif grep -q '^Name .*Version .*ID' "$answer"; then
    cat "$answer"
    found=yes
else
    echo "audit: the packages could not be looked up, so nothing is known about them: $(tail -n 1 "$answer")" >&2
    [ "$found" ] || exit 3
fi
[ -z "$found" ] || exit 6
