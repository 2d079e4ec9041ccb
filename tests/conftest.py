"""What the tests tell at the end."""


def pytest_terminal_summary(terminalreporter):
    """Processor time and peak memory of every notebook that ran, and of all together."""
    reports = [r for kind in ("passed", "failed") for r in terminalreporter.getreports(kind)]
    spent = sorted(
        value
        for r in reports
        if r.when == "call"
        for name, value in r.user_properties
        if name == "notebook"
    )
    if spent:
        terminalreporter.section("notebooks")
        for name, seconds, memory in spent:
            terminalreporter.write_line(f"{name:28}{seconds:8.1f} s{memory:8.0f} MiB")
        total, most = sum(s for _, s, _ in spent), max(m for *_, m in spent)
        terminalreporter.write_line(
            f"{f'{len(spent)} together':28}{total:8.1f} s{most:8.0f} MiB at most"
        )
