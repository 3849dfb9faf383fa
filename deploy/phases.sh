#!/bin/sh
# Run the phases of a test command one after the other, the cheapest first, each with its seconds; the first that fails
# ends it.  phases.sh BIN test|check|live|long|lint [ARGUMENTS OF PYTEST]
set -u
bin=$1
suite=$2
shift 2

phase() {
    name=$1
    shift
    echo "== $name"
    begin=$(date +%s)
    "$@" || {
        code=$?
        echo "== $name: failed after $(($(date +%s) - begin)) s" >&2
        exit $code
    }
    echo "== $name: $(($(date +%s) - begin)) s"
}
lint() {
    "$bin/ruff" check . && "$bin/ruff" format --check . && "$bin/lint-imports" --no-cache
}
pages() {
    "$bin/python" -m timberhand.reference --check && "$bin/sphinx-build" -W --keep-going -q docs docs/_build
}
types_and_pages() { # side by side: the builder of the site uses one processor, mypy would leave it idle at times
    log=$(mktemp)
    pages >"$log" 2>&1 &
    site=$!
    trap 'kill $site; rm -f "$log"; exit 130' INT TERM
    "$bin/mypy"
    types=$?
    wait $site
    site=$?
    trap - INT TERM
    [ $site -eq 0 ] || cat "$log" >&2
    rm -f "$log"
    [ $types -eq 0 ] && [ $site -eq 0 ]
}
fast() {
    "$bin/pytest" -q -m "not long" --ignore=tests/live -n 2 --dist worksteal "$@"
}

case $suite in
lint)
    phase "style and architecture" lint
    phase types "$bin/mypy"
    ;;
check)
    phase "style and architecture" lint
    phase types "$bin/mypy"
    phase tests fast "$@"
    ;;
test)
    phase "style and architecture" lint
    phase "types, and pages of the documentation" types_and_pages
    # With arguments only some of the tests run, and cannot take every branch.
    [ $# -gt 0 ] || set -- --branch-coverage
    phase tests fast --durations=40 --durations-min=2 "$@"
    ;;
live)
    # On the interpreter a forwarder's tick takes a good part of a small computer, and its browser starves.
    phase "compiling the tick" "$bin/timberhand" compile
    phase "live tests" "$bin/pytest" tests/live --durations=20 --durations-min=20 "$@"
    ;;
long)
    phase "long tests" "$bin/pytest" -q -m long --ignore=tests/live -n 2 --dist worksteal --durations=20 --durations-min=30 "$@"
    [ $# -eq 0 ] || exit 0
    phase fuzzing "$bin/python" -m tests.fuzz
    phase mutants "$bin/python" -m tests.mutation
    ;;
esac
