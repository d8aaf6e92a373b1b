"""``tagcell export``: the networks as ONNX files."""

from __future__ import annotations

import dataclasses
import json
import sys
from pathlib import Path
from typing import Any

from twin.scorecard import check_writable


@dataclasses.dataclass(frozen=True, kw_only=True)
class Export:
    """Write the trained networks as ONNX files, each compared with torch; needs the extra `onnx`.

    Writes OUT/NAME.onnx and OUT/networks.json, which describes inputs, outputs and classes.
    """

    out: Path
    """Folder for the files."""
    weights: Path | None = None
    """Folder of trained weights; the ones that come with Tagcell when left out."""
    parts_dir: Path | None = None
    """Folder of your own parts; TAGCELL_PARTS_DIR or your data directory when left out."""
    json: bool = False
    """Print what networks.json holds instead of the table."""

    def run(self) -> None:
        """Export all."""
        from perception.estimator import WEIGHTS
        from perception.export import export_all, runtime
        from perception.exported_networks import exportable_networks

        runtime()
        check_writable(self.out)
        networks = exportable_networks(self.weights or WEIGHTS, self.parts_dir)
        manifest = export_all(networks, self.out, lambda name: print(f"exporting {name}", file=sys.stderr))
        if self.json:
            print(json.dumps(manifest, indent=1))
        else:
            _print(manifest, self.out)


def _print(manifest: dict[str, dict[str, Any]], out: Path) -> None:
    print(f"{'file':26s} {'MB':>5s}  largest difference from torch, over the output's largest value")
    for entry in manifest.values():
        worst = max(entry["differences"].values())
        print(f"{entry['file']:26s} {entry['bytes'] / 1e6:5.1f}  {worst:.1e}")
    print(out / "networks.json")
