"""What a run tells those who wait for it."""

import io
import sys

import numpy as np
import pytest

from wpdc_gwcs import calibrate, simulate
from wpdc_gwcs.cli.progress import progress_bar
from wpdc_gwcs.stages import announce, listening


def test_stages_are_heard_within_the_block_only():
    heard = []
    announce("before")
    with listening(heard.append):
        announce("fits")
        with pytest.raises(ZeroDivisionError), listening(lambda stage: 1 / 0):
            announce("elsewhere")
        announce("files")
    announce("after")
    assert heard == ["fits", "files"]


def test_a_run_tells_the_stages_of_its_frames(tmp_path):
    simulation = simulate(1, image_shape=(700, 700), distortion=5, density=40, seed=4)
    told = []
    calibrate(
        simulation.exposures[0].frame(image=True),
        simulation.reference,
        output=tmp_path,
        progress=lambda *values: told.append(values),
    )
    stages = [stage for stage, done, total in told if total == 0]
    assert stages == [
        *("background", "detection", "PSF", "fits", "companions", "fits"),
        *("matching", "solution", "files"),
    ]
    counted = [(stage, done, total) for stage, done, total in told if total]
    assert counted == [("match", 0, 1), ("match", 1, 1), ("solve", 0, 1), ("solve", 1, 1)]


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.mark.parametrize(("stream", "seen"), [(Terminal, True), (io.StringIO, False)])
def test_a_terminal_shows_them_and_a_pipe_does_not(stream, seen, monkeypatch):
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(sys, "stderr", stream())
    with progress_bar() as progress:
        progress("match", 0, 2)
        progress("background", 0, 0)
        progress("fits", 0, 0)
        progress("match", 1, 2)
    text = sys.stderr.getvalue()
    assert [name in text for name in ("match", "background", "fits", "1/2")] == [seen] * 4
    assert seen or not text


def test_an_image_of_somebody_else_is_left_as_it_is():
    simulation = simulate(1, image_shape=(400, 400), distortion=2, density=60, seed=5)
    exposure = simulation.exposures[0]
    image = exposure.render()
    before = image.copy()
    frame = exposure.frame(image=True)
    object.__setattr__(frame, "load_image", lambda: image)
    calibrate(frame, simulation.reference)
    np.testing.assert_array_equal(image, before)
