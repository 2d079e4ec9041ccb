#!/bin/bash
# Tries what Binder builds: a fresh virtual environment with exactly the files of this folder, on one core, in a copy
# of what git holds.  Installs, runs postBuild and lesson 00, opens both buttons of the README in Chromium; prints
# seconds, memory, sizes.  Ends at the first step that fails, with what that step said.
#   binder/try.sh [PICTURES]    with python3.12 (runtime.txt); PYTHON=... names another; PICTURES gets screenshots
set -euo pipefail
pictures=${1:+--pictures $(realpath -m "$1")}
cd "$(dirname "$0")/.."
python=${PYTHON:-$(sed 's/-//' binder/runtime.txt)}
root=$(mktemp -d)
trap 'rm -rf "$root"' EXIT
mkdir "$root/repository" "$root/home"
git archive HEAD | tar -x -C "$root/repository"
cd "$root/repository"
export HOME="$root/home" OMP_NUM_THREADS=1 PYTHONPATH= PIP_DISABLE_PIP_VERSION_CHECK=1
unset JUPYTER_PATH IPYTHONDIR MPLCONFIGDIR || true
if command -v taskset >/dev/null; then taskset -cp 0 $$ >/dev/null; fi

step() {  # its name, then the command: wall time, processor time and the largest process of it
    "$python" - "$@" <<'PYTHON'
import resource, subprocess, sys, time

start = time.time()
done = subprocess.run(sys.argv[2:], stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
used = resource.getrusage(resource.RUSAGE_CHILDREN)
print(
    f"{sys.argv[1]:32}{time.time() - start:8.0f} s{used.ru_utime + used.ru_stime:8.0f} CPU s"
    f"{used.ru_maxrss / 1024:8.0f} MiB"
)
if done.returncode:
    print(done.stdout.decode(errors="replace"), f"{sys.argv[1]} failed ({done.returncode})", sep="\n")
    sys.exit(1)
PYTHON
}

step "virtual environment" "$python" -m venv "$root/venv"
export PATH="$root/venv/bin:$PATH"
step "install" pip install --quiet -r binder/requirements.txt
step "postBuild" binder/postBuild
step "lesson 00, from a clean kernel" jupyter execute notebooks/00_explore.ipynb
du -sh "$root/venv" binder/study_51 notebooks/study_00 | sed "s#$root/##"
step "a driver of Chromium" pip install --quiet playwright
# shellcheck disable=SC2086
python benchmarks/binder_pages.py $pictures
