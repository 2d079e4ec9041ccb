#!/bin/bash
# A wheel as a new user has it, away from the repository: installed into a fresh environment, then s4a doctor; then run
# without an installation, by uvx and by pipx from the folder of the wheel, as `uvx s4a demo` is once it is published.
# Ends non-zero where the first picture takes more than 60 seconds (LIMIT=... names another number, as on a busy machine),
# of two cores and without downloads.
#   tools/try.sh dist/s4a-0.1.0-py3-none-any.whl [STUDY OPTIONS OF s4a demo...]
set -euo pipefail
wheel=$(realpath "$1")
shift
folder=$(dirname "$wheel")
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
cd "$place"
unset PYTHONPATH
python=$(command -v "${PYTHON:-python3}")
export UV_CACHE_DIR="$place/uv" PIPX_HOME="$place/pipx" PIPX_DEFAULT_PYTHON="$python"
"$python" -m venv venv
venv/bin/python -m pip install --quiet --disable-pip-version-check "$wheel" uv pipx
venv/bin/s4a --version
venv/bin/s4a doctor
uvx=(venv/bin/uvx --python "$python" --find-links "$folder" s4a)
pipx=(venv/bin/pipx run --pip-args="--quiet --find-links=$folder" s4a)
for tool in uvx pipx; do
    declare -n run=$tool
    "${run[@]}" --version # downloads
    begin=$(date +%s)
    "${run[@]}" demo --out "by_$tool" "$@"
    seconds=$(($(date -r "by_$tool/modes.png" +%s) - begin))
    ls -l "by_$tool/study.html"
    echo "$tool: the first picture after $seconds s"
    if [ "$seconds" -gt "${LIMIT:-60}" ]; then
        echo "at most ${LIMIT:-60} s expected, found $seconds: does this machine do something else meanwhile?"
        exit 1
    fi
done
