# SPDX-License-Identifier: Apache-2.0
"""An executor that attends to some timers without rclpy's search for what is to be done."""

from __future__ import annotations

from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.event_handler import EventHandler
from rclpy.executors import SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from rclpy.task import Future


class PromptGroup(ReentrantCallbackGroup):
    """
    A callback group for timers that a `PromptExecutor` calls itself; others treat it as any group.

    Their callbacks are functions, not coroutines.
    """

    def __init__(self) -> None:
        super().__init__()
        self.attended = False

    def can_execute(self, entity: Any) -> bool:
        """See `rclpy.callback_groups.CallbackGroup`."""
        return not self.attended


class PromptExecutor(SingleThreadedExecutor):
    """
    rclpy's executor, with a shorter way from a timer of a `PromptGroup` to its callback.

    For one call of a timer rclpy goes through every entity and makes a new wait set, and once more
    because each callback wakes the executor.  Here one wait set is kept, and all else that becomes
    ready is left to rclpy, which finds it still ready.  Events of publishers and subscriptions
    wake nobody up: rclpy finds them together with what does, such as a timer once a second.
    What a wake-up costs is measured by `python benchmark/wake_up.py`.
    """

    def run_until(self, future: Future) -> None:
        """
        Execute what is to be done until the future is done or the context is shut down.

        Raises what callbacks raise, and perhaps `rclpy.executors.ExternalShutdownException`.
        """
        def goes_on() -> bool:
            return self._context.ok() and not future.done()

        # Once: rclpy's spin_until_future_complete leaves a callback there at each wake-up.
        future.add_done_callback(lambda _: self.wake())
        while goes_on():
            # Twice: the last callback of a round wakes us once more, rclpy first finds that the
            # round is over, and only then looks anew for what that callback has made ready.
            # Without prompt timers it is rclpy that waits.
            for timeout in (0.0, 0.0) if self._attend() else (None,):
                if goes_on():
                    self.spin_once(timeout)

    def _attend(self) -> bool:
        """Call prompt timers until something else is ready; return whether there are any."""
        nodes = self.get_nodes()
        timers = [timer for node in nodes for timer in node.timers]
        prompt = [timer for timer in timers if isinstance(timer.callback_group, PromptGroup)]
        # What rclpy would not find ready any more, or is none of the entities that we know.
        strange = [entity for node in nodes for entity in (
            *node.clients, *node.guards,
            *(waitable for waitable in node.waitables if not isinstance(waitable, EventHandler)))]
        attended = bool(prompt) and not strange
        for timer in prompt:
            timer.callback_group.attended = attended
        if attended:
            others = [timer for timer in timers if self.can_execute(timer)]
            # Who makes or destroys an entity wakes the executor; until then handles are held.
            with ExitStack() as held:
                self._call_until_something_else(prompt, others, held)
        return attended

    def _call_until_something_else(self, prompt: list, others: list, held: ExitStack) -> None:
        """Call the prompt timers whenever they are due, until anything else is ready."""
        def hold(entities: Iterable) -> list:
            handles = [entity.handle for entity in entities]
            for handle in handles:
                held.enter_context(handle)
            return handles

        def of_nodes(kind: str) -> list:
            return [entity for node in self.get_nodes() for entity in getattr(node, kind)
                    if self.can_execute(entity)]

        context, = hold([self._context])
        timers = hold([*prompt, *others])
        subscriptions, services = hold(of_nodes('subscriptions')), hold(of_nodes('services'))
        guards = hold([self._guard, self._sigint_gc])
        wait_set = rclpy_implementation.WaitSet(
            len(subscriptions), len(guards), len(timers), 0, len(services), 0, context)
        additions: list[tuple[Callable, Any]] = [
            *((wait_set.add_timer, handle) for handle in timers),
            *((wait_set.add_subscription, handle) for handle in subscriptions),
            *((wait_set.add_service, handle) for handle in services),
            *((wait_set.add_guard_condition, handle) for handle in guards)]
        calls = {timer.handle.pointer: (timer.handle, timer.callback) for timer in prompt}
        ready, something_else = wait_set.get_ready_entities, False
        while not something_else:
            wait_set.clear_entities()
            for add, handle in additions:
                add(handle)
            wait_set.wait(-1)
            something_else = bool(
                ready('guard_condition') or ready('subscription') or ready('service'))
            for pointer in ready('timer'):
                if pointer in calls:
                    timer, callback = calls[pointer]
                    if timer.is_timer_ready():          # not so after `cancel`
                        timer.call_timer()
                        callback()
                else:
                    something_else = True
