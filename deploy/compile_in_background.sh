#!/bin/sh
# Compile the controller's tick in the background with the virtual environment $1.  Called by `make setup`.
# Never an error: without a C compiler, and until it is ready, the tick runs on the interpreter.
set -u
log=build/compiled/compile.log
command -v cc >/dev/null || command -v gcc >/dev/null || {
    echo "setup: no C compiler, so the tick runs on the interpreter (apt-get install gcc, then timberhand compile)" >&2
    exit 0
}
mkdir -p build/compiled || exit 0
echo "setup: compiling the tick in the background, see $log" >&2
# The lock is held from the first moment, so that a live run that starts now waits (host.compiled.build.await_builder).
nohup nice -n 19 flock build/compiled/.lock-background "$1/bin/timberhand" compile >"$log" 2>&1 </dev/null &
exit 0
