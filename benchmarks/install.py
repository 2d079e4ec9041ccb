"""What a fresh ``pip install`` of S4A brings: packages, sizes and seconds, for each extra.

Builds the wheel, makes a virtual environment for each row and installs into it without pip's cache;
needs the package index. Seconds hold the download and so depend on the network; sizes are of what
lies in site-packages. An analysis with the core alone follows its row.
"""

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).parents[1]
ROWS = {
    "core": "",
    "wrap": "[wrap]",
    "notebook": "[notebook]",
    "course": "[course]",
    "all": "[all]",
}
TRIAL = """
import s4a
study = s4a.analyse(s4a.synthetic.brains(3, 500), n_coarse=200, k=12, k_init=6)
print(study["pca"].sizes["shape"])
"""


def say(line):
    """A line, at once."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def size(path):
    """Bytes of a file, or of all files of a folder."""
    files = path.rglob("*") if path.is_dir() else [path]
    return sum(file.lstat().st_size for file in files if file.is_file())


def run(*command):
    """A command that has to end well, and what it printed."""
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


def install(wheel, extra, folder):
    """A row of the table, and the Python of its environment."""
    run(sys.executable, "-m", "venv", str(folder))
    python = str(folder / "bin" / "python")
    (site,) = folder.glob("lib/python*/site-packages")
    begin, before = time.perf_counter(), size(site)
    run(python, "-m", "pip", "install", "--quiet", "--no-cache-dir", f"{wheel}{extra}")
    seconds = time.perf_counter() - begin
    installed = size(site) - before
    n_packages = len(list(site.glob("*.dist-info"))) - 1  # without pip
    folders = [path for path in site.iterdir() if path.name not in ("pip", "setuptools")]
    largest = sorted(folders, key=size, reverse=True)[:4]
    told = ", ".join(f"{path.name} {size(path) / 1e6:.0f}" for path in largest)
    return python, f"{n_packages} | {installed / 1e6:.0f} | {seconds:.0f} | {told}"


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("rows", nargs="*", choices=[*ROWS, []], help="all by default")
    rows = parser.parse_args().rows or list(ROWS)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        run(sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "-w", name, str(ROOT))
        (wheel,) = folder.glob("s4a-*.whl")
        say(f"wheel {size(wheel) / 1e6:.2f} MB, Python {sys.version.split()[0]}, {sys.platform}")
        say("| install | packages | MB | s | largest, MB |\n|---|---|---|---|---|")
        for row in rows:
            python, cells = install(wheel, ROWS[row], folder / row)
            say(f"| `s4a{ROWS[row]}` | {cells} |")
            if row == "core":
                assert run(python, "-c", TRIAL).strip() == "3"


if __name__ == "__main__":
    main()
