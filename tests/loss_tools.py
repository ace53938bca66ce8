"""The teacher's side of the loss, from its features of all views."""

from freegeo.adaptation.losses import held_out_tokens


def teacher_side(levels, kept, config):
    """The features of the kept views per layer, and the held-out tokens; `levels` are the teacher's of all views."""
    kept_levels = {layer: (patch[:, kept], special[:, kept]) for layer, (patch, special) in levels.items()}
    return kept_levels, held_out_tokens(levels[max(levels)], kept, config)
