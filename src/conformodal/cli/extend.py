"""``conformodal extend``: teach a saved model recordings that came later, after testing it on them."""

from __future__ import annotations

import time
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from conformodal.features.extract import FeatureCache
from conformodal.io import Layout
from conformodal.pipeline.config import OdometryError
from conformodal.pipeline.extend import ASSUMPTION, check_extension, describe_units, extend_model
from conformodal.pipeline.guarantee import describe_guarantee, short_guarantee
from conformodal.pipeline.provenance import provenance
from conformodal.pipeline.results import lock_output, write_metrics
from conformodal.pipeline.store import load_model, model_digest, save_model

from .console import AsJson, Quiet, Verbose, print_json, print_where, progress_bars, report_line
from .sources import Cache, DataLayout, SavedModel, cache_folder, open_sequences


def extend(
    model: SavedModel,
    new: Annotated[list[Path], typer.Argument(metavar="NEW...", help="New recordings with poses, in their order.")],
    out: Annotated[Path, typer.Option(help="Folder for the extended model; must not hold one.")],
    layout: DataLayout = Layout.AUTO,
    trust_poses: Annotated[bool, typer.Option(help="Take poses that do not fit the images.")] = False,
    cache: Cache = None,
    quiet: Quiet = False,
    verbose: Verbose = False,
    as_json: AsJson = False,
) -> None:
    """Extend a model by new recordings: each is answered first, its scores calibrate, then it joins the map."""
    started = time.perf_counter()
    if (out / "model.json").exists():
        raise OdometryError(f"{out}: holds a model already; name a new folder")
    with lock_output(out, "extend", apart=[*new, model]):
        before = load_model(model)
        features = FeatureCache(cache_folder(cache))
        recordings = [open_sequences([path], layout, trust_poses=trust_poses) for path in new]
        checked = [check_extension(before, recording) for recording in recordings]
        for k, (recording, frames) in enumerate(zip(recordings, checked, strict=True)):
            if n := sum(int(earlier.known(frames).sum()) for earlier in checked[:k]):
                raise OdometryError(f"{recording.name}: {n} of its images are in a recording before it")
        with progress_bars(out) as report:
            after = extend_model(before, recordings, cache=features, progress=report)
        save_model(after, out)
        entries = after.journal[len(before.journal) :]
        summary = [
            f"coverage: {short_guarantee(after)}",
            f"tested: {'; '.join(entry.describe() for entry in entries)}",
            f"next: conformodal run {out} SOURCE --out OUT",
        ]
        metrics = {
            "command": "extend",
            "model": model_digest(out),
            "extends": model_digest(model),
            "provenance": provenance(),
            "configuration": after.settings,
            "seed": after.split.seed,
            "guarantee": describe_guarantee(after),
            "verdict": summary,
            "seconds": round(time.perf_counter() - started, 2),
        }
        write_metrics(out, metrics)
    report_line(summary[0])
    for entry in entries:
        report_line(entry.describe())
    report_line(summary[-1])
    report_detail = partial(report_line, detail=True)
    for line in (describe_units(after), ASSUMPTION, describe_guarantee(after)):
        report_detail(line)
    print_where(out)
    print_json(metrics)
