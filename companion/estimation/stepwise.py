"""Work that can be done step by step, so that something more urgent may come in between.

A solution of the window takes many times what a control tick may wait for. So the functions that
solve are generators: between two steps they yield what the step was worth, and another one decides
when they go on. The steps are the same however they are spread over time, and so are the results,
bit for bit; no clock takes part in it. Where nothing is urgent the function is called as any other.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from functools import partial
from typing import Any, Concatenate, Generic, ParamSpec, TypeAlias, TypeVar, overload

P = ParamSpec("P")
S = TypeVar("S")
T = TypeVar("T")

Steps: TypeAlias = Generator[int, None, T]
"""Yields after each step what it took, in measurements that are gone through once."""
PASS_ROWS = 1000
"""What a pass over measurements takes however few they are: the calls of numpy in plain Python.

Measured on one core of a laptop: 0.22 ms and 0.22 us for each measurement; compiled 0.01 ms and
0.19 us. So a unit is no more than a quarter of a microsecond either way."""


def passes(count: int, rows: int) -> int:
    """What it takes to go so many times through so many measurements."""
    return count * (PASS_ROWS + rows)


def finish(steps: Steps[T]) -> T:
    """Go through all steps at once; return the result."""
    while True:
        try:
            next(steps)
        except StopIteration as end:
            result: T = end.value
            return result


def while_same(steps: Steps[None], state: Callable[[], object]) -> Steps[None]:
    """Go through steps; give them up once what they stand on is another one."""
    before = state()
    for cost in steps:
        yield cost
        if state() != before:
            steps.close()


class Callee(Generic[P, T]):
    """A stepwise method of one object: called as a whole, or begun by `steps`."""

    __slots__ = ("steps",)

    def __init__(self, steps: Callable[P, Steps[T]]) -> None:
        self.steps = steps

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> T:
        """Go through all steps at once."""
        return finish(self.steps(*args, **kwargs))


class Stepwise(Generic[S, P, T]):
    """Decorator of a method that yields between its steps."""

    def __init__(self, method: Callable[Concatenate[S, P], Steps[T]]) -> None:
        self._method = method
        self.__doc__ = method.__doc__

    @overload
    def __get__(self, instance: None, owner: type[Any]) -> Callee[Concatenate[S, P], T]: ...

    @overload
    def __get__(self, instance: S, owner: type[Any]) -> Callee[P, T]: ...

    def __get__(self, instance: S | None, owner: type[Any]) -> Any:
        """The method of this object; of none, it takes one as its first argument."""
        method: Callable[..., Any] = self._method
        return Callee(method if instance is None else partial(method, instance))
