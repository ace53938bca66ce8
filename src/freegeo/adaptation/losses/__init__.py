"""The losses of the method: intra, angles and distances, in the paper's and in both released versions.

Reading order: `equations` (the paper, plainly), `sampling` (which tokens), `assemble` (the whole loss), then the fast
forms of the three terms: `intra`, `angles`, `divergence`. `cameras` is a term of ours. The versions are literals in
`freegeo.adaptation.recipe`.
"""

from freegeo.adaptation.losses.assemble import adaptation_loss, feature_distance, teacher_spread
from freegeo.adaptation.losses.cameras import CameraTargets, camera_loss
from freegeo.adaptation.losses.divergence import KLForm, choose_form
from freegeo.adaptation.losses.sampling import Level, StepDraws, TokenDraw, draw_tokens, held_out_tokens

__all__ = [
    "CameraTargets",
    "KLForm",
    "Level",
    "StepDraws",
    "TokenDraw",
    "adaptation_loss",
    "camera_loss",
    "choose_form",
    "draw_tokens",
    "feature_distance",
    "held_out_tokens",
    "teacher_spread",
]
