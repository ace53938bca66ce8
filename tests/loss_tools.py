"""The teacher's side of the loss, from its features of all views."""

from freegeo.adaptation.losses import TeacherTargets, held_out_tokens, teacher_targets


def kept_levels(levels, kept):
    """The features of the kept views, per layer."""
    return {layer: (patch[:, kept], special[:, kept]) for layer, (patch, special) in levels.items()}


def targets_of(levels, kept, draws, config) -> TeacherTargets:
    """What the loss compares a student of the `kept` views with; `levels` are the teacher's of all views."""
    held_out = held_out_tokens(levels[max(levels)], kept, config)
    return teacher_targets(kept_levels(levels, kept), held_out, draws, config)
