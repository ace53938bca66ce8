"""Join report cards of single domains to the tables of docs/embedded-model.md.

freegeo models score freegeo-tiny --domains test-id -o FOLDER/test-id.json      (and so on)
python benchmarks/cards.py FOLDER [--cameras]
"""

import argparse
import json
from pathlib import Path

from freegeo.training.camera_card import CAMERA_DOMAINS, camera_tables
from freegeo.training.report_card import REPORTED_DOMAINS, card_tables, gate_lines


def main() -> None:
    """Print the tables of the cards that are there, in the order of the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--cameras", action="store_true", help="cards with and without cameras")
    options = parser.parse_args()
    domains = CAMERA_DOMAINS if options.cameras else REPORTED_DOMAINS
    files = [options.folder / f"{domain}.json" for domain in domains]
    cards = [json.loads(file.read_text(encoding="utf-8")) for file in files if file.is_file()]
    # The gates judge the first domain.
    whole = {**cards[0], "domains": {name: entry for card in cards for name, entry in card["domains"].items()}}
    print(camera_tables(whole) if options.cameras else "\n".join([card_tables(whole), *gate_lines(whole)]))


if __name__ == "__main__":
    main()
