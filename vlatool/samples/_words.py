"""A vocabulary of robot words and instructions made of them."""

from __future__ import annotations

import numpy as np


def _words(text: str) -> tuple[str, ...]:
    return tuple(text.split())


PAD, UNKNOWN = 0, 1
LONGEST = 30
ARTICLES = ("the", "a")
VERBS = _words(
    "pick place push pull open close lift lower move turn rotate slide press grasp release put take bring hand "
    "stack insert remove pour wipe fold unfold hang flip shake stir sweep drag drop hold reach touch align sort "
    "gather empty fill clean wash dry screw unscrew plug unplug attach detach cover uncover tilt"
)
OBJECTS = _words(
    "apple banana orange lemon pear peach carrot tomato potato onion pepper corn bread egg cup mug glass bottle "
    "can jar bowl plate dish pan pot kettle lid spoon fork knife spatula ladle whisk tongs sponge towel cloth "
    "napkin brush soap box basket bin bucket tray bag drawer cabinet shelf table counter sink stove oven "
    "microwave fridge toaster rack door window handle knob button switch lever valve faucet cable plug socket "
    "hose screw bolt nut nail hammer wrench screwdriver pliers drill saw clamp tape glue ruler pen pencil marker "
    "eraser book notebook paper envelope folder stapler scissors lamp phone remote keyboard mouse monitor charger "
    "battery camera block cube ball cylinder ring peg puck cone disk brick gear toy doll car train puzzle card "
    "coin key lock chain rope shirt sock shoe hat glove blanket pillow chair stool bench ladder cart pallet crate"
)
COLOURS = _words("red green blue yellow orange purple pink brown black white grey silver golden cyan")
SIZES = _words("small large big tiny long short tall round square flat heavy light empty full open closed")
MATERIALS = _words("wooden metal plastic rubber paper steel ceramic soft hard")
SIDES = _words("left right top bottom upper lower middle front back first second third last nearest other")
RELATIONS = ("on", "in", "into", "onto", "under", "behind", "beside", "near", "above", "below", "inside", "against")
PHRASES = (
    "in front of", "next to", "to the left of", "to the right of", "on top of", "away from", "between", "towards",
)  # fmt: skip
JOINTS = ("and", "then", "and then", "before you", "after that")
MANNERS = (*_words("slowly carefully gently quickly again twice"), "with your left arm", "with the gripper", "now")
PARTICLES = _words(
    "go forward backward up down stop wait stay walk drive enter leave follow pass cross corner hallway corridor "
    "room kitchen bathroom bedroom office entrance exit stairs elevator wall floor ceiling please robot arm both "
    "one two three four five half all every each it them from at of to with your you off out over around through "
    "until while not without degrees metres centimetres"
)


def vocabulary() -> dict[str, object]:
    """Return the content of ``vocabulary.json``: each word once, ids from 2 in the order of this file.

    Example:
        >>> vocabulary()["pad"]
        0
    """
    listed = (
        ARTICLES, VERBS, OBJECTS, COLOURS, SIZES, MATERIALS, SIDES, RELATIONS, PHRASES, JOINTS, MANNERS, PARTICLES,
    )  # fmt: skip
    words = dict.fromkeys(word for group in listed for entry in group for word in entry.split())
    return {"kind": "words", "pad": PAD, "unknown": UNKNOWN, "words": {word: 2 + i for i, word in enumerate(words)}}


def instructions(count: int, random: np.random.Generator) -> list[str]:
    """Return ``count`` instructions of 3 to ``LONGEST`` words, all in the vocabulary."""
    return [_instruction(random) for _ in range(count)]


def _instruction(random: np.random.Generator) -> str:
    clauses = [_clause(random)]
    while len(clauses) < 3 and random.random() < 0.4:
        clauses += [_one(JOINTS, random), _clause(random)]
    if random.random() < 0.3:
        clauses.append(_one(MANNERS, random))
    text = " ".join(clauses)
    return text if len(text.split()) <= LONGEST else _instruction(random)


def _clause(random: np.random.Generator) -> str:
    clause = f"{_one(VERBS, random)} {_thing(random)}"
    if random.random() < 0.6:
        clause += f" {_one(RELATIONS + PHRASES, random)} {_thing(random)}"
    return clause


def _thing(random: np.random.Generator) -> str:
    described = [_one(group, random) for group in (SIDES, SIZES, COLOURS, MATERIALS) if random.random() < 0.3]
    return " ".join([_one(ARTICLES, random), *described, _one(OBJECTS, random)])


def _one(group: tuple[str, ...], random: np.random.Generator) -> str:
    return group[int(random.integers(len(group)))]
