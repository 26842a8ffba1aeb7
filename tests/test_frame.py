"""The frame itself: plain, frozen data."""

from dataclasses import FrozenInstanceError

import pytest

from wpdc_gwcs.frame import Frame


def make(**options):
    defaults = {"name": "a", "detector": "d", "image_shape": (4, 5), "wcs": object()}
    return Frame(**{**defaults, "load_image": lambda: None, **options})


def test_defaults():
    frame = make()
    assert (frame.epoch, frame.gain, frame.saturation, frame.meta) == (None, None, None, {})
    assert make().meta is not frame.meta
    with pytest.raises(FrozenInstanceError):
        frame.name = "b"


def test_image_shape_is_a_tuple_of_integers():
    assert make(image_shape=[4.0, 5.0]).image_shape == (4, 5)
    assert isinstance(make(image_shape=[4.0, 5.0]).image_shape[0], int)


@pytest.mark.parametrize("loaders", [{}, {"load_image": int, "load_sources": int}])
def test_exactly_one_loader(loaders):
    with pytest.raises(ValueError, match="needs exactly one of load_image and load_sources"):
        Frame(name="a", detector="d", image_shape=(4, 5), wcs=object(), **loaders)


@pytest.mark.parametrize("shape", [(0, 5), (4,), (4, -1), (4, 5, 6), (4.5, 5), "ab", None])
def test_bad_shapes(shape):
    with pytest.raises(ValueError, match=r"image_shape must be \(ny, nx\).*got"):
        make(image_shape=shape)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_epoch_must_be_finite(value):
    with pytest.raises(ValueError, match="epoch must be a finite Julian year or None, got"):
        make(epoch=value)


def test_a_frame_is_on_its_own_unless_it_has_keys():
    assert (make().exposure, make().camera) == (None, None)
    frame = make(exposure="123", camera="CAM")
    assert (frame.exposure, frame.camera) == ("123", "CAM")
    for key in ("exposure", "camera"):
        for value in ("", 5):
            with pytest.raises(ValueError, match=f"{key} must be a text that is not empty"):
                make(**{key: value})


@pytest.mark.parametrize("name", ["", "a/b"])
def test_names_are_fit_for_files(name):
    with pytest.raises(ValueError, match="name must be fit for a file name, got"):
        make(name=name)
