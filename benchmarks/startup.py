"""CPU time until a command has answered or a module is imported, each in fresh interpreters.

Run: python benchmarks/startup.py [--repeats 7]
"""

import argparse
import statistics
import subprocess
import sys
from pathlib import Path

from record import write_result

HELP = "from freegeo.cli.app import main; main({!r})"
PROGRAMS = {
    "python": "pass",
    "import freegeo": "import freegeo",
    "freegeo --help": HELP.format(["--help"]),
    "freegeo run --help": HELP.format(["run", "--help"]),
    "freegeo models --help": HELP.format(["models", "--help"]),
    "import torch": "import torch",
    "import freegeo.pipeline": "import freegeo.pipeline",
}
TIMED = "import sys, time\n{}\nprint(time.process_time(), 'torch' in sys.modules, file=sys.stderr)"


def cpu_seconds(code: str) -> tuple[float, bool]:
    """Run code in a new interpreter; returns its CPU time and whether it has loaded torch."""
    done = subprocess.run([sys.executable, "-c", TIMED.format(code)], capture_output=True, text=True, check=True)
    seconds, has_torch = done.stderr.split()[-2:]
    return float(seconds), has_torch == "True"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=7)
    repeats = parser.parse_args().repeats
    results = {}
    for name, code in PROGRAMS.items():
        runs = [cpu_seconds(code) for _ in range(repeats)]
        results[name] = {
            "median_cpu_s": round(statistics.median(seconds for seconds, _ in runs), 3),
            "min_cpu_s": round(min(seconds for seconds, _ in runs), 3),
            "loads_torch": runs[0][1],
        }
    path = Path(__file__).parent / "results" / "startup.json"
    write_result(path, settings={"repeats": repeats}, results=results, packages=("torch", "cyclopts", "rich"))


if __name__ == "__main__":
    main()
