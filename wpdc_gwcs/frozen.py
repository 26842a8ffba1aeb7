"""Immutable values, of which results consist."""

import copy

import numpy as np
from astropy.modeling.parameters import Parameter

__all__ = [
    "FrozenDict",
    "freeze",
    "freeze_attributes",
    "freeze_models",
    "frozen_array",
    "with_statistics",
]


class FrozenDict(dict):
    """An immutable dictionary; ``dict(d)`` and ``d | {...}`` are mutable copies.

    Unlike `types.MappingProxyType` it is a `dict`, so that it can be pickled for other processes,
    written as JSON, and copied.
    """

    def _refuse(self, *_, **__):
        raise TypeError("results cannot be changed; dataclasses.replace makes another one")

    __setitem__ = __delitem__ = __ior__ = _refuse
    clear = pop = popitem = setdefault = update = _refuse

    def __reduce__(self):
        return type(self), (dict(self),)


class _FrozenParameter(Parameter):
    """An immutable model parameter; those of copies of the model are mutable."""

    @property
    def value(self):
        """Value of the parameter."""
        return Parameter.value.fget(self)

    @value.setter
    def value(self, value):
        raise TypeError(
            f"{self.name} belongs to a result, which cannot be changed; change a copy of the model"
        )

    def __deepcopy__(self, memo):
        new = memo[id(self)] = Parameter.__new__(Parameter)
        new.__dict__.update(copy.deepcopy(self.__dict__, memo))
        return new


def freeze(value):
    """Return a deeply immutable version of a value.

    Parameters
    ----------
    value : object
        Nested dictionaries, lists, tuples and arrays; other objects are kept as they are.

    Returns
    -------
    frozen : object
        `FrozenDict`, tuple, or read-only copy of an array.
    """
    if isinstance(value, FrozenDict):
        return value
    if isinstance(value, dict):
        return FrozenDict({key: freeze(one) for key, one in value.items()})
    if type(value) in (list, tuple):
        return tuple(map(freeze, value))
    if isinstance(value, np.ndarray):
        value = np.array(value)
        value.flags.writeable = False
    return value


def frozen_array(owner, name, *, shape=None, dtype=float, finite=True):
    """Replace an attribute of a frozen object by a read-only copy as an array.

    Parameters
    ----------
    owner : object
        Frozen dataclass; an attribute that is `None` is kept.
    name : str
        Name of the attribute.
    shape : tuple of int or None, optional
        Shape that it must have; `None` in it for any size.
    dtype : type, optional
        Type of the values.
    finite : bool, optional
        Whether NaN and infinity are refused.

    Returns
    -------
    ndarray or None
        The array.

    Raises
    ------
    ValueError
        If the shape or a value is not allowed.
    """
    value = getattr(owner, name)
    if value is None:
        return None
    value = np.array(value, dtype=dtype)
    if shape is not None and (
        value.ndim != len(shape) or any(n not in (None, m) for n, m in zip(shape, value.shape))
    ):
        raise ValueError(f"{name} must have the shape {shape}, got {value.shape}")
    if finite and not np.isfinite(value).all():
        raise ValueError(f"{name} must be finite, got {value.tolist()}")
    value.flags.writeable = False
    object.__setattr__(owner, name, value)
    return value


def freeze_attributes(owner, *names):
    """Freeze attributes of a frozen dataclass.

    Parameters
    ----------
    owner : object
        The dataclass.
    *names : str
        Names of the attributes.
    """
    for name in names:
        object.__setattr__(owner, name, freeze(getattr(owner, name)))


def freeze_models(owner, *names):
    """Replace models among the attributes of a frozen dataclass by immutable copies.

    Parameters
    ----------
    owner : object
        The dataclass; attributes that are `None` are kept.
    *names : str
        Names of the attributes, which are astropy models.
    """
    for name in names:
        model = getattr(owner, name)
        if model is None or isinstance(getattr(model, model.param_names[0]), _FrozenParameter):
            continue
        model = model.copy()
        for parameter in model.param_names:
            model.__dict__[parameter].__class__ = _FrozenParameter
        object.__setattr__(owner, name, model)


def with_statistics(result, **entries):
    """Return a copy of a result with more statistics.

    Parameters
    ----------
    result : dataclass instance
        Calibration or solution.
    **entries : object
        Entries to add to its ``statistics``.

    Returns
    -------
    result : dataclass instance
        The copy; unlike with `dataclasses.replace`, a WCS that has been built is kept, because it
        does not depend on statistics.
    """
    new = copy.copy(result)
    object.__setattr__(new, "statistics", freeze({**result.statistics, **entries}))
    return new
