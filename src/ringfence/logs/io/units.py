"""Units of a table's columns: numbers times a factor, degrees of longitude and latitude as metres, and angles as their
cosine and sine, since an angle jumps by a turn, and between -pi and pi lies no 0."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ringfence.errors import StoreError, unknown
from ringfence.logs.io.columns import Columns, numbers
from ringfence.logs.io.table_schema import TableSchema

# WGS 84 and the transverse Mercator projection of UTM, by Krüger's series (Karney 2011, to the third order: 1 mm).
RADIUS, FLATTENING = 6378137.0, 1 / 298.257223563
N = FLATTENING / (2 - FLATTENING)
MERIDIAN = RADIUS / (1 + N) * (1 + N**2 / 4 + N**4 / 64)
SERIES = (N / 2 - 2 * N**2 / 3 + 5 * N**3 / 16, 13 * N**2 / 48 - 3 * N**3 / 5, 61 * N**3 / 240)
SCALE, EASTING, NORTHING = 0.9996, 500_000.0, 10_000_000.0
REACH = 9.0  # degrees from a zone's middle, beyond which distances are off by more than a hundredth
POLES = 84.0  # degrees of latitude, where UTM ends

ANGLES = ("theta", "yaw", "heading", "compass", "course", "bearing", "psi")
DEGREES = ("_deg", "_degrees")
RADIANS = ("_rad", "_radians")
TURN = 2 * np.pi + 1e-6


def in_metres(columns: Columns, schema: TableSchema) -> tuple[Columns, list[str]]:
    """The columns in SI units, as the schema's `scale` and `project` say, and what was made of degrees."""
    for name in schema.scale:
        if name not in schema.numbers:
            raise unknown("column of numbers", name, schema.numbers)
    columns = columns | {name: _times(columns, name, factor) for name, factor in schema.scale.items()}
    if schema.project != "utm":
        return columns, []
    pairs = [("x", "y"), schema.goal[:2]] if schema.goal else [("x", "y")]
    degrees = [[numbers(columns, name) for name in pair] for pair in pairs]
    for pair, values in zip(pairs, degrees):
        for name, value, largest in zip(pair, values, (180.0, POLES)):
            _require_degrees(name, value, largest)
    zone, north = zone_of(*degrees[0])
    for pair, values in zip(pairs, degrees):
        columns |= dict(zip(pair, utm(values[0], values[1], zone, north)))
    return columns, [f"degrees of longitude and latitude are metres of UTM zone {zone}{'N' if north else 'S'}"]


def _times(columns: Columns, name: str, factor: float) -> np.ndarray:
    """A column times a factor; what is missing in it stays so, for whoever reads it to judge."""
    column = columns[name]
    return (column if column.dtype.kind in "iuf" else numbers(columns, name)) * factor


def _require_degrees(name: str, value: np.ndarray, largest: float) -> None:
    beyond = np.abs(value) > largest
    if beyond.any():
        row = int(np.flatnonzero(beyond)[0])
        raise StoreError(
            f"row {row}: {name} is {value[row]:.10g}, and degrees of UTM are within {largest:g}; scale it to degrees "
            f"(--scale {name}=1e-7 of tenths of a millionth), drop the row, or see that x is the longitude."
        )


def zone_of(longitude: np.ndarray, latitude: np.ndarray) -> tuple[int, bool]:
    """The UTM zone in which places lie in the mean, 1 to 60, and whether it is of the north."""
    mean = float(np.rad2deg(np.angle(np.exp(1j * np.deg2rad(longitude)).mean())))
    zone = int((mean + 180) // 6) % 60 + 1
    far = np.abs((longitude - _middle(zone) + 180) % 360 - 180)
    if far.max() > REACH:
        row = int(np.flatnonzero(far > REACH)[0])
        raise StoreError(
            f"row {row}: the longitude {longitude[row]:.6g} is {far[row]:.3g} degrees from the middle of UTM zone "
            f"{zone}, where most rows are, and UTM is true within {REACH:g}; import one region at a time."
        )
    return zone, bool(np.median(latitude) >= 0)


def utm(longitude: np.ndarray, latitude: np.ndarray, zone: int, north: bool) -> tuple[np.ndarray, np.ndarray]:
    """Easting and northing (m) of degrees in a UTM zone."""
    sine = np.sin(np.deg2rad(latitude))
    around = np.deg2rad(longitude - _middle(zone))
    bend = 2 * np.sqrt(N) / (1 + N)
    t = np.sinh(np.arctanh(sine) - bend * np.arctanh(bend * sine))
    xi, eta = np.arctan2(t, np.cos(around)), np.arctanh(np.sin(around) / np.hypot(1, t))
    x, y = eta.copy(), xi.copy()
    for k, a in enumerate(SERIES, 1):
        x += a * np.cos(2 * k * xi) * np.sinh(2 * k * eta)
        y += a * np.sin(2 * k * xi) * np.cosh(2 * k * eta)
    return EASTING + SCALE * MERIDIAN * x, (0.0 if north else NORTHING) + SCALE * MERIDIAN * y


def _middle(zone: int) -> float:
    """Degrees of longitude of a zone's middle."""
    return 6.0 * zone - 183.0


# --- angles ---
def without_angles(columns: Columns, schema: TableSchema) -> tuple[Columns, TableSchema, list[str]]:
    """The columns and the schema with `cos_yaw` and `sin_yaw` instead of `yaw`, and a note. Angles are known by their
    names; they are in radians, `compass` and what ends in `_deg` in degrees."""
    angles = [name for name in schema.state if _plain(name) in ANGLES]
    if not angles:
        return columns, schema, []
    found = dict(columns)
    for name in angles:
        angle = _radians(columns, name)
        found |= {f"cos_{name}": np.cos(angle), f"sin_{name}": np.sin(angle)}
    state: list[str] = []
    for name in schema.state:
        state += [f"cos_{name}", f"sin_{name}"] if name in angles else [name]
    note = f"angles are observed as cosine and sine, since they jump by a turn: {', '.join(angles)}"
    return found, replace(schema, state=tuple(state)), [note]


def angle_of(name: str, value: np.ndarray) -> np.ndarray:
    """Radians of an angle of that name."""
    return np.deg2rad(value) if _in_degrees(name) else value


def _radians(columns: Columns, name: str) -> np.ndarray:
    value = numbers(columns, name)
    largest = float(np.abs(value).max())
    if not _in_degrees(name) and not name.endswith(RADIANS) and largest > TURN:
        raise StoreError(
            f"{name} reaches {largest:.4g}: if it is in degrees, call it {name}_deg (--rename {name}={name}_deg), "
            f"if it counts turns in radians, {name}_rad."
        )
    return angle_of(name, value)


def _in_degrees(name: str) -> bool:
    return name.endswith(DEGREES) or _plain(name) == "compass"


def _plain(name: str) -> str:
    """The last word of a dotted name, without its unit."""
    word = name.rpartition(".")[2].lower()
    for unit in (*DEGREES, *RADIANS):
        word = word.removesuffix(unit)
    return word
