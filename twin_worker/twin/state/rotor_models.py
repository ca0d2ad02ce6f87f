"""Rotor models of one multirotor: the active one, the newest, and the prior of the next."""

from dataclasses import replace

import msgspec
import numpy as np

from twin_worker.identification.multirotor.rotor_model import RotorModel
from twin_worker.twin.state.budget import Timer

_MAX_FAILURES = 2  # a single contradiction may be chance: 5 % of right models have one


class RotorModels(msgspec.Struct):
    """Rotor models of a multirotor.

    Attributes:
        active: the accepted model; None before any
        newest: newest model, accepted or not: the next search begins there
        base: model of the flight before the identification window, its prior; None: none yet
        failures: models in a row that held-out flight contradicts
        timer: of identifications
    """

    active: RotorModel | None = None
    newest: RotorModel | None = None
    base: RotorModel | None = None
    failures: int = 0
    timer: Timer = msgspec.field(default_factory=Timer)

    def store(self, newest: RotorModel, *, fails: bool, becomes_base: bool) -> None:
        """Store the newest model; after several that held-out flight contradicts, the aircraft itself has changed.

        Args:
            newest: the model
            fails: held-out flight contradicts it
            becomes_base: it is the prior of the models after it
        """
        self.newest, self.failures = newest, self.failures + 1 if fails else 0
        self.base = newest if becomes_base and not fails else self.base
        if self.failures >= _MAX_FAILURES:
            self.base, self.newest, self.failures = None, None, 0

    def activate(self, model: RotorModel) -> None:
        """Make a model the active one."""
        self.active = model

    def restore(self, model: RotorModel) -> None:
        """Store a model that another worker published."""
        self.active = self.newest = self.base = model

    def forget_times(self) -> None:
        """Forget when the models were identified: the clock was set back."""
        self.timer.expire()
        if self.base is not None:
            self.base = replace(self.base, t0=-np.inf, t1=-np.inf)
        if self.active is not None:
            self.active = replace(self.active, t0=-np.inf, t1=-np.inf)
