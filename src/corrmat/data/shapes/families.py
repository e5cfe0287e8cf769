"""Forty families of parametric, CAD-like objects, named after ModelNet40's categories.

Every family is a function of a random generator: it draws its proportions and returns the
parts of one instance, z up, in any unit. Families whose namesakes are round get something
that breaks the symmetry (a handle, a spout, a drawer), so that a pose is well defined.
"""

from collections.abc import Callable

import numpy as np
from trimesh import Trimesh

from corrmat.data.shapes.solids import ball, box, disc, legs, plate, revolved, rod

Rng = np.random.Generator
Parts = list[Trimesh]


def airplane(rng: Rng) -> Parts:
    """Fuselage, swept wings with engines, tail."""
    length, radius, span = rng.uniform(1.6, 2.4), rng.uniform(0.09, 0.16), rng.uniform(0.7, 1.2)
    sweep, chord, tail = rng.uniform(0.1, 0.5), rng.uniform(0.25, 0.45), rng.uniform(0.2, 0.45)
    parts = [
        ball((length / 2, radius, radius)),
        ball((radius, radius, radius), (length * 0.3, 0, radius / 2)),
    ]
    for side in (-1, 1):
        wing = [
            (chord / 2, 0),
            (-chord / 2, 0),
            (-chord / 2 - sweep, side * span),
            (-sweep, side * span),
        ]
        parts.append(plate(wing, 0.03))
        parts.append(disc(0.06, 0.25, (-sweep * 0.3, side * span * 0.45, -0.08), "x"))
        fin = [(0, 0), (-0.2, 0), (-0.3, side * tail), (-0.18, side * tail)]
        parts.append(plate(fin, 0.02, (-length * 0.36, 0, radius * 0.5)))
    rudder = [(0, 0), (-0.25, 0), (-0.35, tail), (-0.22, tail)]
    return [*parts, plate(rudder, 0.02, (-length * 0.35, 0, radius * 0.6), "y")]


def bathtub(rng: Rng) -> Parts:
    """An open tub on feet with a tap at one end."""
    x, y, z = rng.uniform(0.7, 1.1), rng.uniform(0.35, 0.5), rng.uniform(0.3, 0.5)
    slope = rng.uniform(10, 30)
    parts = [box((2 * x, 2 * y, 0.06), (0, 0, 0.1)), box((0.06, 2 * y, z), (x, 0, z / 2 + 0.1))]
    parts.append(box((0.06, 2 * y, z), (-x - z * 0.2, 0, z / 2 + 0.1), ("y", -slope)))
    parts += [box((2 * x, 0.06, z), (0, s * y, z / 2 + 0.1)) for s in (-1, 1)]
    parts += legs(x * 0.8, y * 0.8, 0.1, 0.04)
    tap = x - 0.02
    return [
        *parts,
        rod((tap, 0, z), (tap, 0, z + 0.3), 0.03),
        rod((tap, 0, z + 0.3), (tap - 0.2, 0, z + 0.25), 0.03),
    ]


def bed(rng: Rng) -> Parts:
    """Mattress, headboard, pillows, legs; sometimes a footboard."""
    x, y, head = rng.uniform(0.9, 1.1), rng.uniform(0.45, 0.9), rng.uniform(0.4, 0.8)
    parts = [
        box((2 * x, 2 * y, 0.2), (0, 0, 0.35)),
        box((0.08, 2 * y, head), (-x, 0, 0.25 + head / 2)),
    ]
    for at in np.linspace(-y / 2, y / 2, rng.integers(1, 3)):
        parts.append(ball((0.16, 0.3 * y, 0.07), (-x + 0.25, at, 0.5)))
    if rng.random() < 0.5:
        parts.append(box((0.06, 2 * y, head / 2), (x, 0, 0.25 + head / 4)))
    return parts + legs(x * 0.92, y * 0.9, 0.25, 0.04)


def bench(rng: Rng) -> Parts:
    """Slats on two frames, one with an armrest."""
    x, back, slats = rng.uniform(0.7, 1.2), rng.uniform(0.35, 0.6), int(rng.integers(2, 5))
    parts = [box((2 * x, 0.1, 0.04), (0, 0.14 * i, 0.45)) for i in range(slats)]
    deep = 0.14 * slats
    parts += [
        box((2 * x, 0.03, 0.1), (0, deep + 0.04 * i, 0.55 + back * 0.4 * i)) for i in range(2)
    ]
    for s in (-0.8, 0.8):
        parts += [box((0.06, 0.06, 0.45), (s * x, y, 0.22)) for y in (0, deep)]
        parts.append(box((0.06, 0.05, back), (s * x, deep + 0.03, 0.45 + back / 2), ("x", -8)))
    return [
        *parts,
        box((0.08, deep, 0.04), (0.85 * x, deep / 2, 0.68)),
        rod((0.85 * x, 0, 0.45), (0.85 * x, 0, 0.68), 0.025),
    ]


def bookshelf(rng: Rng) -> Parts:
    """Shelves with a few rows of books."""
    x, y, z, count = (
        rng.uniform(0.4, 0.8),
        rng.uniform(0.15, 0.25),
        rng.uniform(0.8, 1.2),
        int(rng.integers(3, 6)),
    )
    parts = [box((0.04, 2 * y, 2 * z), (s * x, 0, z)) for s in (-1, 1)]
    parts.append(box((2 * x, 0.02, 2 * z), (0, y, z)))
    for i in range(count + 1):
        level = 2 * z * i / count
        parts.append(box((2 * x, 2 * y, 0.03), (0, 0, level)))
        if i < count and rng.random() < 0.7:
            wide, tall = rng.uniform(0.3, 1.4) * x, rng.uniform(0.5, 0.85) * 2 * z / count
            parts.append(box((wide, 1.4 * y, tall), (-x + wide / 2 + 0.04, 0, level + tall / 2)))
    return parts


def bottle(rng: Rng) -> Parts:
    """A revolved body with shoulder and neck, a handle and a label."""
    body, neck, high = rng.uniform(0.22, 0.4), rng.uniform(0.07, 0.13), rng.uniform(0.7, 1.1)
    top = high + rng.uniform(0.25, 0.5)
    parts = [
        revolved([(0, 0), (body, 0), (body, high), (neck, high + 0.15), (neck, top), (0, top)])
    ]
    grip = [
        (body, 0.3 * high),
        (body + 0.2, 0.35 * high),
        (body + 0.18, 0.8 * high),
        (body, 0.85 * high),
    ]
    parts += [
        rod((a[0], 0, a[1]), (b[0], 0, b[1]), 0.035) for a, b in zip(grip, grip[1:], strict=False)
    ]
    return [*parts, box((0.5 * body, 0.05, 0.4 * high), (0, body, 0.5 * high))]


def bowl(rng: Rng) -> Parts:
    """A revolved bowl with a spout and a spoon."""
    wide, high = rng.uniform(0.5, 0.8), rng.uniform(0.25, 0.5)
    wall = [
        (0, 0),
        (0.35 * wide, 0),
        (0.8 * wide, 0.4 * high),
        (wide, high),
        (wide - 0.04, high),
        (0.3 * wide, 0.08),
    ]
    parts = [revolved(wall), plate([(-0.12, 0), (0.12, 0), (0, 0.2)], 0.04, (0, wide - 0.04, high))]
    end = (rng.uniform(0.8, 1.3) * wide, -0.3 * wide, high + rng.uniform(0.1, 0.4))
    return [*parts, rod((0.1, 0.1, 0.15), end, 0.03), ball((0.12, 0.09, 0.05), (0.08, 0.1, 0.13))]


def car(rng: Rng) -> Parts:
    """Body, cabin set back, bonnet, wheels, a mirror."""
    x, y, z = rng.uniform(0.9, 1.2), rng.uniform(0.35, 0.48), rng.uniform(0.2, 0.32)
    front, rear, roof = rng.uniform(0.1, 0.4), rng.uniform(-0.85, -0.4), rng.uniform(0.22, 0.36)
    side = [
        (x, 0.15),
        (x, z),
        (front + 0.3, z + 0.08),
        (front, z + roof),
        (rear * x + 0.15, z + roof),
        (rear * x - 0.1, z + 0.1),
        (-x, z),
        (-x, 0.15),
    ]
    parts = [plate(side, 2 * y, facing="y")]
    wheel = rng.uniform(0.14, 0.2)
    parts += [
        disc(wheel, 0.12, (sx * 0.62 * x, sy * y, 0.14), "y") for sx in (-1, 1) for sy in (-1, 1)
    ]
    parts.append(box((0.06, 0.14, 0.08), (front + 0.12, y + 0.07, z + 0.1)))
    if rng.random() < 0.4:
        parts.append(box((0.18, 1.6 * y, 0.03), (-0.95 * x, 0, z + 0.2)))
    return parts


def chair(rng: Rng) -> Parts:
    """Seat, legs, a reclined back of slats or a panel, sometimes one or two arms."""
    x, y, seat = rng.uniform(0.35, 0.5), rng.uniform(0.35, 0.5), rng.uniform(0.4, 0.6)
    back, lean = rng.uniform(0.5, 0.9), rng.uniform(3, 15)
    parts = [
        box((2 * x, 2 * y, rng.uniform(0.05, 0.12)), (0, 0, seat)),
        *legs(0.85 * x, 0.85 * y, seat, 0.035, rng.uniform(0, 0.25)),
    ]
    slats = int(rng.integers(1, 5))
    wide = 2 * x / slats * rng.uniform(0.5, 0.95)
    for at in (np.arange(slats) + 0.5) * 2 * x / slats - x:
        parts.append(box((wide, 0.05, back), (at, y + 0.06, seat + back / 2), ("x", -lean)))
    for s in (-1, 1)[: rng.integers(0, 3)]:
        parts += [
            box((0.06, 1.7 * y, 0.04), (s * x, 0, seat + 0.25)),
            rod((s * x, -0.7 * y, seat), (s * x, -0.7 * y, seat + 0.25), 0.03),
        ]
    return parts


def cone(rng: Rng) -> Parts:
    """A traffic cone on a square foot, with a sign clipped to one side."""
    foot, high, tip = rng.uniform(0.4, 0.6), rng.uniform(0.9, 1.4), rng.uniform(0.04, 0.12)
    parts = [
        box((2 * foot, 2 * foot, 0.08)),
        revolved([(0, 0.04), (0.75 * foot, 0.04), (tip, high), (0, high)]),
    ]
    sign = rng.uniform(0.2, 0.4)
    return [
        *parts,
        box((0.03, sign, 0.8 * sign), (0.5 * foot, 0.1, 0.55 * high)),
        rod((0, 0, high), (0.2, 0.1, high + 0.25), 0.03),
    ]


def cup(rng: Rng) -> Parts:
    """A hollow cup with a handle and a stirrer."""
    wide, foot, high = rng.uniform(0.35, 0.5), rng.uniform(0.22, 0.35), rng.uniform(0.6, 0.95)
    wall = [(0, 0), (foot, 0), (wide, high), (wide - 0.04, high), (foot - 0.04, 0.05), (0, 0.05)]
    reach = rng.uniform(0.2, 0.35)
    ring = [
        (wide - 0.06, 0.25 * high),
        (wide + reach, 0.3 * high),
        (wide + reach, 0.7 * high),
        (wide - 0.03, 0.8 * high),
    ]
    parts = [
        revolved(wall),
        *(
            rod((a[0], 0, a[1]), (b[0], 0, b[1]), 0.04)
            for a, b in zip(ring, ring[1:], strict=False)
        ),
    ]
    return [*parts, rod((0, 0.05, 0.08), (-0.2, wide * 0.8, high + 0.25), 0.02)]


def curtain(rng: Rng) -> Parts:
    """A folded curtain drawn to one side of its rail."""
    wide, high, folds = rng.uniform(0.5, 0.9), rng.uniform(1.2, 1.8), int(rng.integers(4, 8))
    x = np.linspace(0, wide, 2 * folds + 1)
    y = 0.06 * np.where(np.arange(len(x)) % 2, 1, -1) * rng.uniform(0.6, 1.4, len(x))
    outline = [*zip(x, y, strict=True), *zip(x[::-1], y[::-1] - 0.03, strict=True)]
    rail = wide * rng.uniform(1.3, 2)
    return [
        plate(outline, high),
        rod((-0.1, 0, high / 2), (rail, 0, high / 2), 0.03),
        ball((0.06, 0.06, 0.06), (rail, 0, high / 2)),
        box((0.06, 0.18, 0.08), (0.1 * wide, 0.05, -0.1 * high)),
    ]


def desk(rng: Rng) -> Parts:
    """A top on legs with a drawer block on one side and a back panel."""
    x, y, z = rng.uniform(0.7, 1.1), rng.uniform(0.35, 0.5), rng.uniform(0.6, 0.8)
    block, drawers = rng.uniform(0.3, 0.5), int(rng.integers(2, 4))
    parts = [
        box((2 * x, 2 * y, 0.05), (0, 0, z)),
        box((block, 1.9 * y, 0.8 * z), (x - block / 2, 0, 0.58 * z)),
    ]
    for i in range(drawers):
        parts.append(
            box((0.5 * block, 0.04, 0.03), (x - block / 2, -y, z * (0.35 + 0.5 * i / drawers)))
        )
    parts += [box((0.06, 0.06, z), (-0.95 * x, s * 0.9 * y, z / 2)) for s in (-1, 1)]
    return [*parts, box((1.2 * x, 0.03, 0.4 * z), (-0.3 * x, 0.9 * y, 0.75 * z))]


def door(rng: Rng) -> Parts:
    """A leaf with panels, a frame, a handle and hinges."""
    x, z, panels = rng.uniform(0.4, 0.6), rng.uniform(0.9, 1.2), int(rng.integers(1, 4))
    ajar = rng.uniform(0, 35)
    leaf = [box((2 * x, 0.06, 2 * z))]
    for i in range(panels):
        leaf.append(
            box((1.4 * x, 0.1, 1.4 * z / panels), (0, 0, (2 * i + 1 - panels) * z / panels))
        )
    leaf.append(rod((0.8 * x, 0, 0), (0.8 * x, -0.15, 0), 0.03))
    leaf.append(rod((0.8 * x, -0.15, 0), (0.5 * x, -0.15, 0), 0.03))
    swing = np.deg2rad(ajar)
    rotation = np.eye(4)
    rotation[:2, :2] = [[np.cos(swing), np.sin(swing)], [-np.sin(swing), np.cos(swing)]]
    for part in leaf:
        part.apply_translation((x, 0, 0)).apply_transform(rotation)
    frame = [box((0.08, 0.12, 2 * z), (at, 0, 0)) for at in (-0.04, 2 * x + 0.04)]
    return [*leaf, *frame, box((2 * x + 0.16, 0.12, 0.08), (x, 0, z))]


def dresser(rng: Rng) -> Parts:
    """A cabinet of drawers with knobs, feet and a tilted mirror."""
    x, y, z = rng.uniform(0.6, 0.9), rng.uniform(0.25, 0.35), rng.uniform(0.5, 0.8)
    rows, columns = int(rng.integers(2, 5)), int(rng.integers(1, 4))
    parts = [box((2 * x, 2 * y, z), (0, 0, 0.1 + z / 2)), *legs(0.9 * x, 0.85 * y, 0.1, 0.04)]
    for i in range(rows):
        for j in range(columns):
            at = ((2 * j + 1 - columns) * x / columns, -y - 0.02, 0.1 + z * (i + 0.5) / rows)
            parts.append(box((1.7 * x / columns, 0.03, 0.75 * z / rows), at))
            parts.append(ball((0.03, 0.04, 0.03), (at[0], at[1] - 0.04, at[2])))
    mirror = rng.uniform(0.4, 0.7)
    return [
        *parts,
        box(
            (x, 0.04, mirror),
            (rng.uniform(-0.3, 0.3) * x, 0.8 * y, 0.1 + z + mirror / 2),
            ("x", -8),
        ),
    ]


def flower_pot(rng: Rng) -> Parts:
    """A revolved pot with a bent stem, leaves and a blossom."""
    foot, rim, high = rng.uniform(0.2, 0.3), rng.uniform(0.3, 0.45), rng.uniform(0.35, 0.6)
    parts = [
        revolved([(0, 0), (foot, 0), (rim, high), (rim - 0.05, high), (foot - 0.02, 0.1), (0, 0.1)])
    ]
    knots = [np.array([0, 0, 0.1])]
    for _ in range(3):
        knots.append(knots[-1] + [*rng.uniform(-0.15, 0.15, 2), rng.uniform(0.25, 0.4)])
        out = rng.uniform(-0.35, 0.35, 2)
        parts.append(rod(knots[-1], knots[-1] + [*out, 0.15], 0.02))
        parts.append(ball((0.15, 0.06, 0.03), knots[-1] + [*out, 0.17]))
    parts += [rod(a, b, 0.03) for a, b in zip(knots, knots[1:], strict=False)]
    return [*parts, ball((0.16, 0.16, 0.08), knots[-1])]


def glass_box(rng: Rng) -> Parts:
    """A frame of edges with a lid ajar and something inside."""
    x, y, z = rng.uniform(0.4, 0.7, 3)
    parts = [box((2 * x, 2 * y, 0.04), (0, 0, -z))]
    parts += [
        rod((sx * x, sy * y, -z), (sx * x, sy * y, z), 0.03) for sx in (-1, 1) for sy in (-1, 1)
    ]
    parts += [rod((-x, s * y, z), (x, s * y, z), 0.03) for s in (-1, 1)]
    parts += [rod((s * x, -y, z), (s * x, y, z), 0.03) for s in (-1, 1)]
    tilt = rng.uniform(10, 50)
    lift = y * np.sin(np.deg2rad(tilt))
    parts.append(box((2 * x, 2 * y, 0.03), (0, 0, z + lift), ("x", tilt)))
    return [*parts, ball(rng.uniform(0.15, 0.3, 3), (0.3 * x, -0.2 * y, -0.6 * z))]


def guitar(rng: Rng) -> Parts:
    """A waisted body with a cutaway, neck, head with pegs and a bridge."""
    lower, waist, upper = rng.uniform(0.38, 0.48), rng.uniform(0.2, 0.28), rng.uniform(0.28, 0.36)
    half = [
        (-0.5, 0.1),
        (-0.45, 0.8 * lower),
        (-0.2, lower),
        (0.1, waist),
        (0.35, upper),
        (0.5, 0.7 * upper),
    ]
    other = [(x, -y) for x, y in half[::-1]]
    other[0] = (0.4, -0.3 * upper)
    neck, thick = rng.uniform(0.9, 1.2), rng.uniform(0.1, 0.2)
    parts = [plate([*half, *other], thick), box((neck, 0.1, 0.06), (0.4 + neck / 2, 0, thick / 2))]
    head = 0.4 + neck
    parts.append(box((0.3, 0.16, 0.05), (head + 0.12, 0, thick / 2 - 0.02), ("y", 12)))
    for i in range(3):
        parts += [
            rod(
                (head + 0.05 + 0.09 * i, s * 0.08, 0.05),
                (head + 0.05 + 0.09 * i, s * 0.16, 0.05),
                0.02,
            )
            for s in (-1, 1)
        ]
    return [
        *parts,
        box((0.06, 0.25, 0.04), (-0.25, 0, thick / 2 + 0.02)),
        disc(0.1, 0.02, (0.12, 0, thick / 2)),
    ]


def keyboard(rng: Rng) -> Parts:
    """A wedge with rows of keys, a number pad and a cable."""
    x, y = rng.uniform(0.9, 1.2), rng.uniform(0.3, 0.42)
    parts = [plate([(-y, 0), (y, 0), (y, 0.14), (-y, 0.05)], 2 * x, facing="x")]
    rows = int(rng.integers(3, 6))
    for i in range(rows):
        at = -y + 2 * y * (i + 0.5) / rows
        start = rng.uniform(-0.95, -0.8) * x
        parts.append(
            box(
                (0.45 * x - start, 1.3 * y / rows, 0.05),
                ((0.45 * x + start) / 2, at, 0.11 + 0.045 * at / y),
            )
        )
        parts.append(box((0.35 * x, 1.3 * y / rows, 0.05), (0.75 * x, at, 0.11 + 0.045 * at / y)))
    return [*parts, rod((0.3 * x, y, 0.08), (rng.uniform(0.2, 0.6) * x, y + 0.5, 0.05), 0.02)]


def lamp(rng: Rng) -> Parts:
    """A desk lamp: foot, two jointed arms, a shade that looks aside."""
    foot, first, second = rng.uniform(0.25, 0.4), rng.uniform(0.5, 0.9), rng.uniform(0.4, 0.8)
    lean, bend = np.deg2rad(rng.uniform(5, 40)), np.deg2rad(rng.uniform(40, 100))
    elbow = np.array([-first * np.sin(lean), 0, first * np.cos(lean)])
    end = elbow + second * np.array([np.sin(bend), rng.uniform(-0.2, 0.2), np.cos(bend)])
    shade = rng.uniform(0.2, 0.32)
    parts = [
        disc(foot, 0.07),
        rod((0, 0, 0), elbow, 0.03),
        rod(elbow, end, 0.03),
        ball((0.06, 0.06, 0.06), elbow),
    ]
    parts.append(revolved([(0.06, 0.1), (shade, -0.25), (shade - 0.03, -0.25), (0.03, 0.08)], end))
    return [
        *parts,
        ball((0.08, 0.08, 0.1), end - [0, 0, 0.12]),
        box((0.08, 0.12, 0.05), (0.5 * foot, 0.3 * foot, 0.05)),
    ]


def laptop(rng: Rng) -> Parts:
    """Base with keys and a touchpad, screen opened by some angle, a plug at one side."""
    x, y, angle = rng.uniform(0.6, 0.8), rng.uniform(0.4, 0.55), np.deg2rad(rng.uniform(5, 45))
    parts = [
        box((2 * x, 2 * y, 0.06)),
        box((1.7 * x, 0.8 * y, 0.03), (0, 0.2 * y, 0.04)),
        box((0.5 * x, 0.4 * y, 0.02), (-0.1 * x, -0.6 * y, 0.035)),
    ]
    middle = (0, y + y * np.sin(angle), 0.03 + y * np.cos(angle))
    parts.append(box((2 * x, 0.04, 2 * y), middle, ("x", -np.rad2deg(angle))))
    return [*parts, rod((x, 0.5 * y, 0), (x + 0.3, rng.uniform(0.3, 0.7) * y, -0.01), 0.025)]


def mantel(rng: Rng) -> Parts:
    """A fireplace surround with a shelf, a hearth, a vase and a clock."""
    x, z, post = rng.uniform(0.7, 1.0), rng.uniform(0.7, 0.95), rng.uniform(0.15, 0.25)
    parts = [box((post, 0.2, z), (s * (x - post / 2), 0, z / 2)) for s in (-1, 1)]
    parts += [
        box((2 * x, 0.2, 0.22), (0, 0, z - 0.1)),
        box((2.2 * x, 0.35, 0.06), (0, -0.06, z + 0.03)),
    ]
    parts += [
        box((2.1 * x, 0.5, 0.06), (0, -0.2, -0.03)),
        box((2 * x - 2 * post, 0.03, z), (0, 0.1, z / 2)),
    ]
    parts.append(
        revolved(
            [(0, 0), (0.07, 0), (0.12, 0.15), (0.05, 0.3), (0, 0.3)],
            (rng.uniform(0.4, 0.9) * x, -0.05, z + 0.06),
        )
    )
    return [
        *parts,
        disc(rng.uniform(0.1, 0.16), 0.08, (rng.uniform(-0.7, 0) * x, -0.05, z + 0.2), "y"),
    ]


def monitor(rng: Rng) -> Parts:
    """A screen on an arm and foot, buttons at the lower right, a box behind."""
    x, z = rng.uniform(0.6, 1.0), rng.uniform(0.4, 0.6)
    foot, tilt = rng.uniform(0.25, 0.45), rng.uniform(-10, 15)
    parts = [
        box((2 * x, 0.08, 2 * z), (0, 0, z + 0.3), ("x", tilt)),
        box((0.6 * x, 0.12, 0.7 * z), (rng.uniform(-0.1, 0.2) * x, 0.1, z + 0.3)),
    ]
    parts += [
        rod((0, 0.12, 0), (0, 0.12, z), 0.05),
        box((2 * foot, 1.2 * foot, 0.04), (0, 0.05, 0)),
    ]
    for i in range(int(rng.integers(2, 5))):
        parts.append(ball((0.03, 0.03, 0.03), (x * (0.9 - 0.12 * i), -0.05, 0.34)))
    return parts


def night_stand(rng: Rng) -> Parts:
    """A small cabinet: a drawer, an open shelf, a lamp's foot on top."""
    x, y, z = rng.uniform(0.3, 0.45), rng.uniform(0.28, 0.4), rng.uniform(0.5, 0.7)
    parts = [box((2 * x, 2 * y, 0.04), (0, 0, level)) for level in (0.15, 0.55 * z, z)]
    parts += [box((0.04, 2 * y, z - 0.15), (s * x, 0, (z + 0.15) / 2)) for s in (-1, 1)]
    parts += [
        box((2 * x, 0.03, 0.45 * z), (0, -y, 0.78 * z)),
        box((0.5 * x, 0.04, 0.03), (0, -y - 0.04, 0.78 * z)),
    ]
    parts += legs(0.9 * x, 0.85 * y, 0.15, 0.03)
    side = rng.choice((-1, 1)) * 0.4 * x
    return [
        *parts,
        disc(0.12, 0.03, (side, 0.2 * y, z + 0.03)),
        rod((side, 0.2 * y, z), (side, 0.2 * y, z + rng.uniform(0.2, 0.5)), 0.025),
    ]


def person(rng: Rng) -> Parts:
    """A figure in a pose: head, trunk, four limbs of two segments each."""
    high, wide = rng.uniform(0.5, 0.65), rng.uniform(0.16, 0.22)
    parts = [
        ball((wide, 0.12, high / 2), (0, 0, 0.9 + high / 2)),
        ball((0.1, 0.11, 0.14), (0, -0.02, 1.05 + high)),
    ]
    for side in (-1, 1):
        for start, lengths, spread in (
            ((side * wide, 0, 0.85 + high), (0.3, 0.28), 1.2),
            ((side * 0.1, 0, 0.92), (0.45, 0.45), 0.5),
        ):
            at = np.array(start)
            for length in lengths:
                swing, out = rng.uniform(-spread, spread) * 0.7, side * rng.uniform(0, spread) * 0.5
                step = length * np.array(
                    [np.sin(out), -np.sin(swing), -np.cos(out) * np.cos(swing)]
                )
                parts.append(rod(at, at + step, 0.05))
                at = at + step
            parts.append(ball((0.05, 0.09, 0.04), at - [0, 0.04, 0]))
    return parts


def piano(rng: Rng) -> Parts:
    """A grand piano: curved body, raised lid, keys, three legs, a stool."""
    x, y = rng.uniform(0.55, 0.75), rng.uniform(0.7, 1.0)
    outline = [
        (-x, -0.4),
        (x, -0.4),
        (x, 0.1),
        (0.55 * x, 0.3),
        (0.35 * x, 0.8 * y),
        (0, y),
        (-0.7 * x, y),
        (-x, 0.8 * y),
    ]
    parts = [plate(outline, 0.22, (0, 0, 0.65)), box((1.8 * x, 0.22, 0.06), (0, -0.5, 0.62))]
    parts += [
        rod((a, b, 0), (a, b, 0.55), 0.05)
        for a, b in ((-0.85 * x, -0.3), (0.85 * x, -0.3), (-0.3 * x, 0.8 * y))
    ]
    tilt = rng.uniform(20, 45)
    parts.append(
        box(
            (1.6 * x, y, 0.03),
            (-0.3 * x, 0.3 * y, 0.78 + 0.75 * x * np.sin(np.deg2rad(tilt))),
            ("y", -tilt),
        )
    )
    return [
        *parts,
        box((0.6 * x, 0.3, 0.06), (rng.uniform(-0.3, 0.3), -0.95, 0.4)),
        rod((0, -0.95, 0), (0, -0.95, 0.4), 0.05),
    ]


def plant(rng: Rng) -> Parts:
    """A pot and many leaning leaves."""
    pot, high = rng.uniform(0.2, 0.35), rng.uniform(0.3, 0.45)
    parts = [revolved([(0, 0), (0.7 * pot, 0), (pot, high), (0, high)])]
    for _ in range(int(rng.integers(5, 10))):
        around, lean, length = (
            rng.uniform(0, 2 * np.pi),
            rng.uniform(0.1, 1.0),
            rng.uniform(0.4, 1.0),
        )
        way = np.array([np.cos(around) * np.sin(lean), np.sin(around) * np.sin(lean), np.cos(lean)])
        tip = np.array([0, 0, high]) + length * way
        parts += [rod((0, 0, high), tip, 0.018), ball(rng.uniform(0.05, 0.17, 3), tip)]
    return parts


def radio(rng: Rng) -> Parts:
    """A case with a loudspeaker, dials, a handle and an aerial."""
    x, y, z = rng.uniform(0.5, 0.8), rng.uniform(0.15, 0.25), rng.uniform(0.3, 0.45)
    parts = [box((2 * x, 2 * y, 2 * z)), disc(0.7 * z, 0.08, (-0.45 * x, -y, 0), "y")]
    for i in range(int(rng.integers(2, 4))):
        parts.append(disc(0.08, 0.1, (x * (0.15 + 0.3 * i), -y, -0.5 * z), "y"))
    parts += [
        box((0.7 * x, 0.04, 0.35 * z), (0.5 * x, -y, 0.4 * z)),
        box((1.2 * x, 0.06, 0.05), (0, 0, z + 0.15)),
    ]
    parts += [rod((s * 0.6 * x, 0, z), (s * 0.6 * x, 0, z + 0.15), 0.025) for s in (-1, 1)]
    return [
        *parts,
        rod(
            (0.9 * x, 0.5 * y, z),
            (x * rng.uniform(0.9, 1.5), 0.5 * y, z + rng.uniform(0.4, 0.9)),
            0.02,
        ),
    ]


def range_hood(rng: Rng) -> Parts:
    """A sloped hood, an offset chimney, a filter and switches."""
    x, y, z = rng.uniform(0.6, 0.9), rng.uniform(0.4, 0.55), rng.uniform(0.25, 0.45)
    parts = [plate([(-y, 0), (y, 0), (y, z), (-0.2 * y, z), (-y, 0.12)], 2 * x, facing="x")]
    duct, high = rng.uniform(0.15, 0.25), rng.uniform(0.5, 0.9)
    parts.append(
        box((2 * duct, 1.6 * duct, high), (rng.uniform(-0.3, 0.3) * x, 0.5 * y, z + high / 2))
    )
    parts += [
        ball((0.04, 0.04, 0.03), (x * (0.5 + 0.13 * i), -y, 0.06))
        for i in range(int(rng.integers(2, 5)))
    ]
    return [*parts, box((1.2 * x, 1.2 * y, 0.03), (-0.2 * x, 0, -0.02))]


def sink(rng: Rng) -> Parts:
    """A counter with a basin to one side, a tap, a drain pipe."""
    x, y, deep = rng.uniform(0.6, 0.9), rng.uniform(0.35, 0.45), rng.uniform(0.2, 0.35)
    at, half = rng.uniform(-0.4, 0.4) * x, rng.uniform(0.22, 0.32)
    parts = [
        box((x + at - half, 2 * y, 0.05), ((-x + at - half) / 2, 0, 0)),
        box((x - at - half, 2 * y, 0.05), ((x + at + half) / 2, 0, 0)),
    ]
    parts += [box((2 * half, 0.04, deep), (at, s * 0.7 * y, -deep / 2)) for s in (-1, 1)]
    parts += [box((0.04, 1.4 * y, deep), (at + s * half, 0, -deep / 2)) for s in (-1, 1)]
    parts += [
        box((2 * half, 1.4 * y, 0.04), (at, 0, -deep)),
        rod((at, 0, -deep), (at, 0, -deep - 0.35), 0.05),
    ]
    rise = rng.uniform(0.25, 0.45)
    return [
        *parts,
        rod((at, 0.85 * y, 0), (at, 0.85 * y, rise), 0.035),
        rod((at, 0.85 * y, rise), (at + 0.05, 0.2 * y, rise - 0.05), 0.03),
        disc(0.05, 0.08, (at + 0.18, 0.85 * y, 0.05)),
    ]


def sofa(rng: Rng) -> Parts:
    """Seat, back, arms of different kinds, cushions; sometimes a chaise on one side."""
    x, y, back = rng.uniform(0.8, 1.2), rng.uniform(0.35, 0.45), rng.uniform(0.35, 0.55)
    parts = [
        box((2 * x, 2 * y, 0.3), (0, 0, 0.25)),
        box((2 * x, 0.2, back), (0, y, 0.4 + back / 2), ("x", -6)),
    ]
    parts += [box((0.18, 2 * y, rng.uniform(0.3, 0.5)), (s * x, 0, 0.4)) for s in (-1, 1)]
    for at in np.linspace(-0.6 * x, 0.6 * x, int(rng.integers(2, 4))):
        parts.append(ball((0.2, 0.1, 0.17), (at + rng.uniform(-0.1, 0.1), y - 0.2, 0.55)))
    if rng.random() < 0.5:
        parts.append(
            box(
                (0.7 * x, y * rng.uniform(0.8, 1.6), 0.28),
                (rng.choice((-1, 1)) * 0.65 * x, -1.5 * y, 0.25),
            )
        )
    return parts


def stairs(rng: Rng) -> Parts:
    """A flight of steps with a rail on one side and a landing."""
    count, rise, run, x = (
        int(rng.integers(4, 9)),
        rng.uniform(0.12, 0.2),
        rng.uniform(0.2, 0.3),
        rng.uniform(0.3, 0.6),
    )
    parts = [
        box((2 * x, run, rise * (i + 1)), (0, run * i, rise * (i + 1) / 2)) for i in range(count)
    ]
    rail = rng.uniform(0.4, 0.6)
    parts += [
        rod((x, run * i, rise * (i + 1)), (x, run * i, rise * (i + 1) + rail), 0.02)
        for i in range(0, count, 2)
    ]
    parts.append(rod((x, 0, rise + rail), (x, run * (count - 1), rise * count + rail), 0.035))
    return [
        *parts,
        box((2 * x, 2 * run, 0.06), (rng.uniform(-0.5, 0) * x, run * (count + 0.5), rise * count)),
    ]


def stool(rng: Rng) -> Parts:
    """A round seat on splayed legs with rungs at different heights and a low back."""
    wide, high, splay = rng.uniform(0.28, 0.42), rng.uniform(0.6, 1.0), rng.uniform(0.1, 0.5)
    half = 0.6 * wide
    parts = [disc(wide, 0.07, (0, 0, high)), *legs(half, half, high, 0.03, splay)]
    for i, (a, b) in enumerate((((-1, -1), (1, -1)), ((1, -1), (1, 1)), ((-1, 1), (1, 1)))):
        level = high * (0.25 + 0.15 * i)
        out = half * (1 + splay * (1 - level / high))
        parts.append(rod((a[0] * out, a[1] * out, level), (b[0] * out, b[1] * out, level), 0.02))
    return [*parts, box((wide, 0.04, rng.uniform(0.1, 0.35)), (0, wide, high + 0.15))]


def table(rng: Rng) -> Parts:
    """A top with an overhang, legs, an apron, a drawer and a thing left on it."""
    x, y, z = rng.uniform(0.6, 1.1), rng.uniform(0.4, 0.7), rng.uniform(0.55, 0.8)
    parts = [
        box((2 * x, 2 * y, 0.06), (0, 0, z)),
        *legs(0.85 * x, 0.85 * y, z, rng.uniform(0.03, 0.06), rng.uniform(0, 0.1)),
    ]
    parts += [
        box((1.7 * x, 0.03, 0.12), (0, 0.8 * y, z - 0.1)),
        box((0.5 * x, 0.3, 0.1), (rng.uniform(-0.5, 0.5) * x, -0.8 * y, z - 0.09)),
    ]
    at = (rng.uniform(-0.8, 0.8) * x, rng.uniform(-0.6, 0.6) * y)
    return [*parts, disc(rng.uniform(0.06, 0.2), rng.uniform(0.1, 0.4), (*at, z + 0.15))]


def tent(rng: Rng) -> Parts:
    """A ridge tent with a fly, an open flap, poles and guy lines."""
    x, z, length = rng.uniform(0.5, 0.75), rng.uniform(0.6, 0.9), rng.uniform(0.8, 1.2)
    lean = np.rad2deg(np.arctan2(x, z))
    slant = np.hypot(x, z)
    parts = [
        box((0.03, 2 * length, slant), (s * x / 2, 0, z / 2), ("y", -s * lean)) for s in (-1, 1)
    ]
    parts += [
        plate([(-x, 0), (x, 0), (0, z)], 0.03, (0, length, 0), "y"),
        plate([(0, 0), (x, 0), (0, z)], 0.03, (0.05, -length - 0.1, 0), "y"),
    ]
    parts += [rod((0, s * length, 0), (0, s * length, z * 1.1), 0.025) for s in (-1, 1)]
    reach = rng.uniform(0.3, 0.6)
    return [
        *parts,
        rod((0, -length, z), (0.1, -length - reach, 0), 0.015),
        box((0.9 * x, 0.5, 0.03), (rng.uniform(0.3, 0.6), -length - 0.25, z * 0.7), ("x", 10)),
    ]


def toilet(rng: Rng) -> Parts:
    """Bowl, seat, raised lid, cistern with a lever on one side."""
    wide, high, deep = rng.uniform(0.25, 0.33), rng.uniform(0.4, 0.5), rng.uniform(1.1, 1.4)
    bowl_part = revolved(
        [
            (0, 0),
            (0.6 * wide, 0),
            (0.5 * wide, 0.4 * high),
            (wide, high),
            (0.7 * wide, high),
            (0, 0.5 * high),
        ]
    )
    parts = [
        bowl_part.apply_scale((1, deep, 1)),
        box((1.1 * wide, 0.5, 0.7 * high), (0, wide, 0.35 * high)),
    ]
    tank = rng.uniform(0.35, 0.5)
    parts += [
        box((2.2 * wide, 0.2, tank), (0, wide * deep + 0.12, high + tank / 2)),
        box((1.7 * wide, 0.04, 1.6 * wide), (0, wide * deep - 0.05, high + 0.8 * wide), ("x", -8)),
    ]
    return [
        *parts,
        rod(
            (-0.8 * wide, wide * deep, high + 0.8 * tank),
            (-0.5 * wide, wide * deep - 0.08, high + 0.78 * tank),
            0.025,
        ),
    ]


def tv_stand(rng: Rng) -> Parts:
    """A low board with compartments, devices and a screen off centre."""
    x, y, z = rng.uniform(0.8, 1.1), rng.uniform(0.22, 0.32), rng.uniform(0.3, 0.45)
    parts = [box((2 * x, 2 * y, 0.04), (0, 0, level)) for level in (0.05, z)]
    parts += [
        box((0.04, 2 * y, z), (at * x, 0, z / 2))
        for at in (-1, rng.uniform(-0.4, 0), rng.uniform(0.2, 0.6), 1)
    ]
    parts += [
        box((0.4 * x, 1.4 * y, 0.1), (rng.uniform(-0.7, -0.5) * x, 0, 0.12)),
        box((0.35 * x, 0.03, 0.85 * z), (0.8 * x, -y, z / 2)),
    ]
    wide, tall = rng.uniform(0.8, 1.4) * x, rng.uniform(0.5, 0.7)
    at = rng.uniform(-0.2, 0.3) * x
    return [
        *parts,
        box((wide, 0.05, tall), (at, 0, z + 0.12 + tall / 2)),
        box((0.3, 0.2, 0.1), (at, 0, z + 0.06)),
    ]


def vase(rng: Rng) -> Parts:
    """A revolved vase with one or two handles, a spout and twigs."""
    belly, neck, high = rng.uniform(0.3, 0.45), rng.uniform(0.1, 0.18), rng.uniform(0.8, 1.1)
    waist = rng.uniform(0.3, 0.6) * high
    parts = [
        revolved(
            [
                (0, 0),
                (0.5 * belly, 0),
                (belly, waist),
                (neck, 0.85 * high),
                (1.4 * neck, high),
                (1.1 * neck, high),
                (0.7 * neck, 0.8 * high),
            ]
        )
    ]
    out = belly + rng.uniform(0.05, 0.2)
    for s in (1, -1)[: rng.integers(1, 3)]:
        parts += [
            rod((s * belly * 0.9, 0, waist), (s * out, 0, 0.75 * high), 0.03),
            rod((s * out, 0, 0.75 * high), (s * neck, 0, 0.9 * high), 0.03),
        ]
    for _ in range(int(rng.integers(1, 4))):
        parts.append(
            rod(
                (0, 0, 0.8 * high),
                (*rng.uniform(-0.35, 0.35, 2), high + rng.uniform(0.2, 0.5)),
                0.015,
            )
        )
    return [*parts, plate([(-0.06, 0), (0.06, 0), (0, 0.14)], 0.04, (0, 1.2 * neck, high - 0.02))]


def wardrobe(rng: Rng) -> Parts:
    """Two doors of different width, one ajar, handles, a plinth and a cornice."""
    x, y, z = rng.uniform(0.5, 0.8), rng.uniform(0.25, 0.35), rng.uniform(0.9, 1.1)
    parts = [
        box((2 * x, 2 * y, 2 * z), (0, 0, z)),
        box((2.15 * x, 2.3 * y, 0.08), (0, 0, 2 * z + 0.04)),
    ]
    split, angle = rng.uniform(-0.3, 0.3) * x, rng.uniform(15, 60)
    left, right = split + x, x - split
    parts.append(box((0.95 * left, 0.04, 1.8 * z), (split - left / 2, -y - 0.02, z)))
    swing = np.deg2rad(angle)
    parts.append(
        box(
            (0.95 * right, 0.04, 1.8 * z),
            (x - right / 2 * np.cos(swing), -y - right / 2 * np.sin(swing), z),
            ("z", angle),
        )
    )
    return [
        *parts,
        box((0.03, 0.06, 0.3), (split - 0.12, -y - 0.07, z)),
        *legs(0.9 * x, 0.8 * y, 0.01, 0.05),
    ]


def xbox(rng: Rng) -> Parts:
    """A console lying down with a slot, vents, and a controller beside it."""
    x, y, z = rng.uniform(0.5, 0.7), rng.uniform(0.35, 0.5), rng.uniform(0.1, 0.18)
    parts = [
        box((2 * x, 2 * y, 2 * z)),
        box((0.9 * x, 0.03, 0.04), (-0.3 * x, -y, 0.3 * z)),
        disc(0.06, 0.05, (0.75 * x, -y, 0), "y"),
    ]
    parts += [
        box((0.04, y, 0.03), (x * (0.3 + 0.12 * i), 0.2 * y, z))
        for i in range(int(rng.integers(3, 6)))
    ]
    at = np.array([rng.uniform(-0.3, 0.5), -y - rng.uniform(0.4, 0.6), -z + 0.08])
    parts += [
        box((0.36, 0.16, 0.08), at),
        *(ball((0.09, 0.15, 0.07), at + [s * 0.18, -0.06, 0]) for s in (-1, 1)),
    ]
    return [
        *parts,
        rod(at + [-0.08, 0.02, 0.03], at + [-0.08, 0.02, 0.12], 0.03),
        rod(at + [0, 0.06, 0], (0.2, -y, -0.5 * z), 0.015),
    ]


FAMILIES: dict[str, Callable[[Rng], Parts]] = {
    family.__name__: family
    for family in (
        airplane, bathtub, bed, bench, bookshelf, bottle, bowl, car, chair, cone,
        cup, curtain, desk, door, dresser, flower_pot, glass_box, guitar, keyboard, lamp,
        laptop, mantel, monitor, night_stand, person, piano, plant, radio, range_hood, sink,
        sofa, stairs, stool, table, tent, toilet, tv_stand, vase, wardrobe, xbox,
    )
}  # fmt: skip
