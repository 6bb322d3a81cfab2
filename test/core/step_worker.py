"""A worker in the process of the test, whose tasks end on request."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from mr_damper_ros.processes.worker import Done, Failed, Outcome, Progress


@dataclass
class StepWorker:
    """Replaces the worker process: a task ends at the poll after :meth:`work` is called."""

    failing: bool = False
    function: Callable[..., Any] | None = None
    arguments: tuple[Any, ...] = ()
    number: int = 0
    stopped: bool = False
    busy: bool = False
    outcomes: list[Outcome] = field(default_factory=list)

    def submit(self, function: Callable[..., Any], *arguments: Any, budget: float) -> int:
        assert not self.busy, "one task at a time"
        self.function, self.arguments, self.stopped, self.busy = function, arguments, False, True
        self.number += 1
        return self.number

    def cancel(self) -> None:
        self.stopped = True

    def should_stop(self) -> bool:
        return self.stopped

    def report(self, value: Any) -> bool:
        self.outcomes.append(Progress(self.number, value))
        return not self.stopped

    def work(self) -> None:
        if self.function is None:
            return
        function, self.function = self.function, None
        if self.failing:
            self.outcomes.append(Failed(self.number, "the worker process died"))
        else:
            self.outcomes.append(Done(self.number, function(*self.arguments, self)))

    def poll(self) -> list[Outcome]:
        outcomes, self.outcomes, self.busy = self.outcomes, [], self.function is not None
        return outcomes

    def take_notices(self) -> list[str]:
        return []
