"""A weather station whose messages have changed since tests/runner/weather-1.mcap was recorded by an early runner.

Then: ``Reading(celsius, place, unit="C", last=False)``, ``Place(name)`` and ``Forecast(celsius, place, readings,
last=False)``. Since then a field was renamed, one of a struct inside too, one retired, and three were gained; and the
class ``Forecast`` is called ``Outlook``.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from numpy.typing import NDArray

from runner.contract import Context, Finished, Message, Migration, Spec, Stage, Struct

Vector = Annotated[NDArray[np.float64], Spec("float64", ("N",))]

MIGRATIONS = {
    ("Reading", 1): Migration(renamed={"celsius": "temperature", "place.name": "station"}, retired=("unit",)),
    ("Reading", 2): Migration(change=lambda fields: {**fields, "humidity": 0.5}),
    ("Forecast", 1): Migration(renamed={"place.name": "station"}),
}


class Place(Struct, frozen=True, kw_only=True):
    station: str
    height: float = 0.0


class Reading(Message, frozen=True, kw_only=True):
    version: ClassVar[int] = 3
    temperature: Vector
    humidity: float
    place: Place
    last: bool = False


class Outlook(Message, frozen=True, kw_only=True):
    known_as = "Forecast"
    version: ClassVar[int] = 2
    celsius: Vector
    place: Place
    readings: int
    spread: float = 0.0
    last: bool = False


class Thermometer(Stage):
    device = True

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Config:
        count: int = 12

    def __init__(self, config: Config):
        self._count = config.count

    def source(self, ctx: Context) -> Iterator[Reading]:
        rng = np.random.default_rng(3)
        for number in range(self._count):
            place = Place(station=f"roof {number % 2}")
            yield Reading(temperature=rng.normal(15, 5, 4), humidity=0.4, place=place, last=number == self._count - 1)


class Forecaster(Stage):
    """Keeps a running mean, which a replay must build up again."""

    def __init__(self):
        self._readings = 0
        self._mean = np.zeros(4)

    def on_reading(self, reading: Reading, ctx: Context) -> Outlook:
        self._readings += 1
        self._mean = self._mean + (reading.temperature - self._mean) / self._readings
        guess = self._mean + ctx.rng.normal(0, 0.1, 4)
        spread = float(np.ptp(guess))
        return Outlook(celsius=guess, place=reading.place, readings=self._readings, spread=spread, last=reading.last)


class Newspaper(Stage):
    device = True

    def on_forecast(self, forecast: Outlook) -> Finished | None:
        return Finished(code=0, reason="printed") if forecast.last else None
