"""The public address of the repository, from one value, and what has to hold before a release.

``release.py address [NAME/s4a]``: writes the address into every file that says it; without one,
the value of ``[tool.s4a]`` in ``pyproject.toml``.
``release.py check VERSION``: what stands against releasing this version, line by line; ends with 1
where anything does. It uploads nothing.
``release.py paper``: what the two papers lack before they are submitted; only their authors can
say some of it, so that no release waits for it.
"""

import argparse
import re
import subprocess
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]
UNKNOWN = "OWNER"
# every file with the address, and the pattern whose first group is what stands before it
PLACES = {
    "pyproject.toml": r'(= "https://github\.com/|^repository = ")[\w.-]+/[\w.-]+(?=["/])',
    "README.md": r"(https://mybinder\.org/v2/gh/)[\w.-]+/[\w.-]+(?=/HEAD)",
    "CITATION.cff": r'(repository-code: "https://github\.com/)[\w.-]+/[\w.-]+(?=")',
    "SECURITY.md": r"(https://github\.com/)[\w.-]+/[\w.-]+(?=/security)",
    "s4a/cli/__init__.py": r'(PAGE = "https://github\.com/)[\w.-]+/[\w.-]+(?=/blob)',
    "paper/paper.md": r"(https://github\.com/)[\w.-]+/s4a(?=\))",
    "paper/jose.md": r"(https://github\.com/)[\w.-]+/s4a(?=\))",
}
# the sections that each journal asks for, in its order, and how many words it takes
PAPERS = {
    "paper/paper.md": (
        "Summary",
        "Statement of need",
        "State of the field",
        "Software design",
        "Research impact statement",
        "AI usage disclosure",
        "Acknowledgements",
        "References",
    ),
    "paper/jose.md": ("Summary", "Statement of need", "Acknowledgements", "References"),
}
WORDS = {"paper/paper.md": (750, 1750)}
TO_STATE = "To be stated by the authors"
UNTIL = re.compile(r"<!-- unpublished -->.*?<!-- /unpublished -->", re.DOTALL)


def repository(root=ROOT):
    """The value that all addresses are made from."""
    project = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))
    return project["tool"]["s4a"]["repository"]


def with_address(text, pattern, name):
    """A text with the address of `name`; what is said until publication goes with the first."""
    if not name.startswith(UNKNOWN + "/"):
        text = UNTIL.sub("", text)
    return re.sub(pattern, lambda found: found[1] + name, text, flags=re.MULTILINE)


def write_address(name, root=ROOT):
    """Write the address into every place."""
    for file, pattern in PLACES.items():
        path = root / file
        text = path.read_text(encoding="utf-8")
        path.write_text(with_address(text, pattern, name), encoding="utf-8")


def tracked(root=ROOT):
    """The files that git knows, as relative paths."""
    found = subprocess.run(
        ["git", "ls-files"], cwd=root, capture_output=True, text=True, check=True
    ).stdout
    return [Path(line) for line in found.splitlines()]


def says_unknown(files, root=ROOT):
    """The lines of files that still say that the address is not known."""
    spared = {"tools/release.py", "tests/project/test_release.py", "Makefile", "RELEASING.md"}
    for file in files:
        if file.as_posix() in spared or not (root / file).is_file():
            continue
        text = (root / file).read_bytes().decode("utf-8", errors="replace")
        for number, line in enumerate(text.splitlines(), 1):
            if re.search(rf"\b{UNKNOWN}/|<!-- unpublished", line):
                yield f"{file}:{number}: {line.strip()[:80]}"


def faults(version, root=ROOT, files=None):
    """What stands against releasing a version."""
    project = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    found = list(says_unknown(tracked(root) if files is None else files, root))
    said = {
        "pyproject.toml": project["version"],
        "CITATION.cff": _first(r"^version: (\S+)", root / "CITATION.cff"),
        "conda/recipe.yaml": _first(r'^  version: "([^"]+)"', root / "conda" / "recipe.yaml"),
        "CHANGELOG.md": _first(r"^## ([\w.]+)", root / "CHANGELOG.md"),
    }
    found += [f"{file}: version {v}, not {version}" for file, v in said.items() if v != version]
    if not _first(rf"^## {re.escape(version)}, (\d{{4}}-\d\d-\d\d)$", root / "CHANGELOG.md"):
        found.append(f"CHANGELOG.md: no line '## {version}, YYYY-MM-DD'")
    if not _first(r"^date-released: (\d{4}-\d\d-\d\d)$", root / "CITATION.cff"):
        found.append("CITATION.cff: no date-released: YYYY-MM-DD")
    return found


def lacking(paper, root=ROOT):
    """What a paper lacks before it is submitted, line by line."""
    text = (root / paper).read_text(encoding="utf-8")
    _, head, body = text.split("---\n", 2)
    sections = re.findall(r"^# (.+)$", body, re.MULTILINE)
    wanted = PAPERS[paper]
    if [name for name in sections if name in wanted] != list(wanted):
        yield f"sections {', '.join(wanted)} in this order, found {', '.join(sections)}"
    if not re.search(r"^date: \d{1,2} [A-Z][a-z]+ \d{4}$", head, re.MULTILINE):
        yield "date: DAY MONTH YEAR in its head"
    for words in ("S4A developers", "see CITATION.cff"):
        if words in head:
            yield f"names of people and institutions instead of {words!r}"
    for part in re.split(r"^# ", body, flags=re.MULTILINE):
        if TO_STATE in part:
            yield f"{part.splitlines()[0]}: the authors' own statement"
    few, many = WORDS.get(paper, (0, 10**6))
    count = len(re.sub(r"<!--.*?-->", "", body, flags=re.DOTALL).split())
    if not few <= count <= many:
        yield f"{few} to {many} words, found {count}"


def _first(pattern, path):
    found = re.search(pattern, path.read_text(encoding="utf-8"), re.MULTILINE)
    return found[1] if found else None


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("address").add_argument("name", nargs="?", default=repository())
    commands.add_parser("check").add_argument("version")
    commands.add_parser("paper")
    args = parser.parse_args(arguments)
    if args.command == "address":
        if not re.fullmatch(r"[\w.-]+/[\w.-]+", args.name):
            parser.error(f"an address as NAME/s4a needed, found {args.name!r}")
        write_address(args.name)
        return 0
    if args.command == "paper":
        found = [f"{paper}: {what}" for paper in PAPERS for what in lacking(paper)]
        sys.stdout.write("".join(f"{line}\n" for line in found))
        return 1 if found else 0
    found = faults(args.version)
    sys.stdout.write("".join(f"{line}\n" for line in found))
    sys.stdout.write(f"{len(found)} things stand against releasing {args.version}\n")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
