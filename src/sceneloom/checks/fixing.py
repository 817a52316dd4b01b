"""Repairing a scene by the fixes of its rules."""

from collections.abc import Sequence

from sceneloom.checks.rule import Rule
from sceneloom.checks.subject import Subject
from sceneloom.checks.walk import Hits, find_all
from sceneloom.scene.scene import Scene

_MOST_ROUNDS = 8
"""A fix may bring to light what another repairs; none needs more rounds than there are such steps."""


def repaired(scene: Scene, rules: Sequence[Rule], hits: Hits) -> tuple[Scene, frozenset[str]]:
    """Apply fixes until nothing is found that one of them would change.

    Args:
        scene: what the hits were found in.
        rules: those whose fixes may be applied.
        hits: of the first search, in frames as well; later ones look at what is known without reading.

    Returns:
        The repaired scene, and the ids of the rules whose fixes were applied.
    """
    fixable = [rule for rule in rules if rule.fix is not None]
    applied: set[str] = set()
    for _ in range(_MOST_ROUNDS):
        before = scene
        for rule in fixable:
            if rule.fix is not None and hits.get(rule.id):
                scene = rule.fix(scene)
                applied.add(rule.id)
        if scene is before:
            break
        hits = find_all(Subject(scene), fixable, frames=False)
    return scene, frozenset(applied)
