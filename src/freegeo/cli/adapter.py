"""`freegeo adapter`: what can be done with a saved adapter besides reconstructing with it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter

from freegeo.cli import console
from freegeo.cli.options import model_of_adapter
from freegeo.errors import UserError
from freegeo.models.spec import NO_REFERENCE

app = App(name="adapter", help="Fold a saved adapter into the weights of its model.", help_format="plaintext")
SUFFIX = ".safetensors"


@app.command
def merge(
    adapter: Path,
    *,
    output: Annotated[Path, Parameter(name=("--output", "-o"))],
    strength: float = 1.0,
    model: str | None = None,
    checkpoint: Path | None = None,
    overwrite: bool = False,
) -> None:
    """Fold an adapter into the weights of its model: a weight file for --checkpoint that needs no adapter.

    The file has the layout of the model's official checkpoint and the licence of its weights.

    Parameters
    ----------
    adapter
        Folder of a saved adapter, or the output folder of a run.
    output
        The weight file, FILE.safetensors.
    strength
        0 is the frozen model, 1 the adapted one, and between them the weights are interpolated.
    model
        Name or hub id of the model; default: the one that the adapter was made for.
    checkpoint
        Local weight file or folder of the model, instead of the download.
    overwrite
        Replace an existing file.
    """
    if output.suffix != SUFFIX:
        raise UserError(f"{output}: merged weights are written as {SUFFIX}. Choose such a name.")
    if output.exists() and not overwrite:
        raise UserError(f"{output}: exists already. Add --overwrite to replace it, or choose another name.")
    from freegeo.adaptation.adapter_files import find_adapter, load_adapter
    from freegeo.models import catalog
    from freegeo.models.checkpoints import fingerprint, save_weights
    from freegeo.runs import adapter_identity

    adapter = find_adapter(adapter)
    name = model_of_adapter(adapter, model)
    identity = adapter_identity(adapter)
    loaded = catalog.load_model(name, checkpoint=checkpoint)
    folded = load_adapter(loaded, adapter)
    folded.set_strength(strength)
    folded.merge()
    spec, base = loaded.spec, loaded.loaded_from
    assert base is not None
    about = {
        "format": "pt", "model": name, "licence": spec.weights_licence, "base": base.fingerprint,
        "adapter": identity["weights"], "strength": f"{strength:g}",
    }  # fmt: skip
    save_weights(loaded, output, catalog.entry(name).keys, about)
    console.say(f"{output}: {console.size(output)}, fingerprint {fingerprint(output)}")
    console.say(f"licence of the weights: {spec.weights_licence}")
    reference = "" if spec.reference in ("first", NO_REFERENCE) else " --reference first"
    console.say(f"use it: freegeo reconstruct PHOTOS -o OUT --model {name} --checkpoint {output}{reference}")
