#!/bin/bash
# Tries what Binder builds: a fresh virtual environment with exactly the files of this folder, on one core, in a copy
# of what git holds.  Installs, runs postBuild, lesson 00 and the page of the sliders; prints seconds, memory, sizes.
#   binder/try.sh            with python3.12 (runtime.txt); PYTHON=... names another
set -euo pipefail
cd "$(dirname "$0")/.."
python=${PYTHON:-$(sed 's/-//' binder/runtime.txt)}
root=$(mktemp -d)
trap 'kill "${server:-}" 2>/dev/null || true; rm -rf "$root"' EXIT
mkdir "$root/repository" "$root/home"
git archive HEAD | tar -x -C "$root/repository"
cd "$root/repository"
export HOME="$root/home" OMP_NUM_THREADS=1 PYTHONPATH=
unset JUPYTER_PATH IPYTHONDIR MPLCONFIGDIR || true
if command -v taskset >/dev/null; then taskset -cp 0 $$ >/dev/null; fi

spent() {  # what it is, then the command: wall time, processor time and the largest process of it
    "$python" - "$@" <<'PYTHON'
import resource, subprocess, sys, time

start = time.time()
code = subprocess.call(sys.argv[2:], stdout=sys.stderr)
used = resource.getrusage(resource.RUSAGE_CHILDREN)
sys.stdout.write(
    f"{sys.argv[1]:32}{time.time() - start:8.0f} s{used.ru_utime + used.ru_stime:8.0f} CPU s{used.ru_maxrss / 1024:8.0f} MiB\n"
)
sys.exit(code)
PYTHON
}

"$python" -m venv "$root/venv"
export PATH="$root/venv/bin:$PATH"
{
    spent "install" pip install --quiet --disable-pip-version-check -r binder/requirements.txt
    spent "postBuild" binder/postBuild
    pip install --quiet --disable-pip-version-check nbmake
    spent "lesson 00, from a clean kernel" python -m pytest -q -p no:cacheprovider -c /dev/null --rootdir . --nbmake notebooks/00_explore.ipynb
    du -sh "$root/venv" binder/study_51 notebooks/study_00 | sed "s#$root/##"
} 2>"$root/log" || { cat "$root/log"; exit 1; }

port=$("$python" -c 'import socket; s = socket.socket(); s.bind(("", 0)); print(s.getsockname()[1])')
voila binder/pca.ipynb --no-browser --port "$port" >"$root/voila" 2>&1 &
server=$!
for _ in $(seq 60); do
    if curl --silent --fail --max-time 120 "http://localhost:$port/" >"$root/page.html" 2>/dev/null; then break; fi
    sleep 1
done
if grep -q "application/vnd.jupyter.widget-view+json" "$root/page.html" && ! grep -q Traceback "$root/page.html"; then
    echo "the page of the sliders: $(wc -c <"$root/page.html") bytes, with its panel"
else
    cat "$root/voila"
    exit 1
fi
