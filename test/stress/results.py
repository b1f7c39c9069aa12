"""Damaged and hostile results of a fit, and summaries of recordings: refused, or as if sound."""

from collections.abc import Iterator
from contextlib import redirect_stderr, redirect_stdout
import functools
import io
import json
from pathlib import Path
import tempfile
from typing import Any

from bellows_ros.cli.app import main
from bellows_ros.core.geometry.arrays import Array
from bellows_ros.errors import BellowsError
from bellows_ros.files.parameter_files import read_parameters
from bellows_ros.workflows.compare import compare_files
from bellows_ros.workflows.identification import Identification, save
from bellows_ros.workflows.identify import identify, identify_summaries, write_summary
import numpy as np

from .frame import CLEAN, damaged, Failed, REFUSED, scrambled, SILENT, TEXTS
from .readers import ATTEMPTS, refused_well, ROOT

VALUES: tuple[Any, ...] = (
    None, True, -1, 0, 10**30, 1e308, -1e-320, '', [], {}, [[1.0]], {'a': None}, *TEXTS[:3])
ARRAYS = (
    np.array(np.nan), np.zeros(0), np.zeros((6, 6)), np.full((6, 6), 1e200), np.array('text'),
    np.zeros((3, 3), complex), np.ones(6, bool), np.arange(10**6))


@functools.cache
def sound(structure: str) -> tuple[bytes, str]:
    """Return a summary of a recording, and the result of the fit to it."""
    settings = {
        **read_parameters(ROOT / 'bags/package.yaml'), 'fit.structure': structure,
        'fit.method': 'least_squares', 'bags': [str(ROOT / 'bags/validation')]}
    with tempfile.TemporaryDirectory() as folder:
        summary, result = Path(folder) / 'one.npz', Path(folder) / 'fit.json'
        write_summary(settings, summary)
        save(identify(settings), None, result)
        return summary.read_bytes(), result.read_text()


def replaced(rng: np.random.Generator, content: Any) -> Any:
    """Replace some value in nested content, or leave it out; return the content."""
    if not isinstance(content, dict | list) or not content or rng.random() < 0.1:
        return VALUES[rng.integers(len(VALUES))]
    keys = list(content) if isinstance(content, dict) else range(len(content))
    key = keys[rng.integers(len(keys))]
    if rng.random() < 0.1:
        del content[key]
    else:
        content[key] = replaced(rng, content[key])
    return content


def hostile_summary(rng: np.random.Generator, whole: bytes) -> bytes:
    """Return a summary that is a sound archive, with a strange header or a strange array."""
    with np.load(io.BytesIO(whole)) as archive:
        arrays = dict(archive)
    name = str(rng.choice(list(arrays)))
    if rng.random() < 0.5:
        header = json.loads(arrays['header'].tobytes())
        header['content'] = replaced(rng, header['content'])
        arrays['header'] = np.frombuffer(json.dumps(header).encode(), np.uint8)
    elif rng.random() < 0.2:
        del arrays[name]
    elif rng.random() < 0.5:
        arrays[name] = ARRAYS[rng.integers(len(ARRAYS))]
    else:
        own = np.array(arrays[name])
        own.flat[rng.integers(max(own.size, 1)):][:1] = rng.choice([0, 7, 255])
        arrays[name] = own * (1e155 if own.dtype == float and rng.random() < 0.3 else 1)
    packed = io.BytesIO()
    np.savez_compressed(packed, **arrays)
    return packed.getvalue()


def summaries(rng: np.random.Generator, folder: Path) -> Iterator[str]:
    """Damage summaries, and fit what can be read; damage of stored bytes is never silent."""
    whole = sound(str(rng.choice(['axisymmetric', 'full'])))[0]
    file, out = folder / 'one.npz', folder / 'fit.json'
    file.write_bytes(whole)
    good = figures(identify_summaries([file]))
    for _ in range(ATTEMPTS):
        stored = rng.random() < 0.4
        file.write_bytes(damaged(rng, whole) if stored else hostile_summary(rng, whole))
        try:
            found = identify_summaries([file])
            save(found, None, out)
        except BellowsError as error:
            if str(file) not in str(error):
                raise Failed(f'no name in: {error}') from error
            yield refused_well(error)
            continue
        if found.fit.usable and not np.all(np.isfinite(figures(found))):
            raise Failed('a cup that is not finite can be used')
        same = np.array_equal(figures(found), good, equal_nan=True)
        if stored and not same:
            raise Failed('a change that the checksums show was not reported')
        yield CLEAN if same else SILENT


def figures(found: Identification) -> Array:
    """Return the numbers of a fit."""
    return np.array([found.fit.stiffness, found.fit.damping])


def fits(rng: np.random.Generator, folder: Path) -> Iterator[str]:
    """Damage results, and compare and report them."""
    text = sound('axisymmetric')[1]
    whole, other = folder / 'whole.json', folder / 'other.json'
    whole.write_text(text)
    for _ in range(ATTEMPTS // 3):
        other.write_text(scrambled(rng, text) if rng.random() < 0.3
                         else json.dumps(replaced(rng, json.loads(text))), errors='replace')
        if rng.random() < 0.2:
            with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
                code = main(['report', str(other), '--out', str(folder / 'page.html')])
            yield CLEAN if code == 0 else REFUSED
            continue
        pair = (whole, other) if rng.random() < 0.5 else (other, whole)
        try:
            json.dumps(compare_files(*pair).as_json(), default=list)
        except BellowsError as error:
            if str(folder) not in str(error):
                raise Failed(f'no name in: {error}') from error
            yield refused_well(error)
            continue
        yield CLEAN if json.loads(other.read_text()) == json.loads(text) else SILENT
