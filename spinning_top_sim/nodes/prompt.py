# SPDX-License-Identifier: Apache-2.0
"""An executor that calls ticks and subscriptions without rclpy's search for what is to be done."""

from __future__ import annotations

from contextlib import ExitStack, suppress
from typing import TYPE_CHECKING, Any

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.event_handler import EventHandler
from rclpy.executors import ShutdownException, SingleThreadedExecutor, TimeoutException
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.subscription import Subscription

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from rclpy.task import Future
    from rclpy.timer import Timer


class PromptGroup(ReentrantCallbackGroup):
    """For timers that a `PromptExecutor` calls itself; others treat it as any callback group."""

    def __init__(self) -> None:
        super().__init__()
        self.attended = False

    def can_execute(self, entity: Any) -> bool:
        """See `rclpy.callback_groups.CallbackGroup`."""
        return not self.attended


class PromptExecutor(SingleThreadedExecutor):
    """
    rclpy's executor, with a shorter way to timers of a `PromptGroup` and to subscriptions.

    For one call of a timer rclpy goes through every entity and makes a new wait set, and once more
    because each callback wakes the executor.  Here one wait set is kept, and all else that becomes
    ready is left to rclpy, which finds it still ready.  Callbacks of those timers and of all
    subscriptions are functions, not coroutines.  Events of publishers and subscriptions wake
    nobody up: rclpy finds them together with what does, such as a timer once a second.
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
            if not self._attend():
                self.spin_once()
            elif goes_on():
                self._execute_what_is_ready()

    def _execute_what_is_ready(self) -> None:
        """Have rclpy look once, and execute all that it finds; each callback wakes us again."""
        with suppress(TimeoutException, ShutdownException):
            while True:
                task, _, _ = self.wait_for_ready_callbacks(timeout_sec=0.0)
                task()
                if task.exception() is not None:
                    raise task.exception()

    def _attend(self) -> bool:
        """Do the prompt things until something else is ready; return whether this is possible."""
        nodes = self.get_nodes()
        # What rclpy would not find ready any more, or is none of the entities that we know.
        strange = [entity for node in nodes for entity in (
            *node.clients, *node.guards,
            *(waitable for waitable in node.waitables if not isinstance(waitable, EventHandler)))]
        timers = [timer for node in nodes for timer in node.timers]
        prompt = [timer for timer in timers if isinstance(timer.callback_group, PromptGroup)]
        for timer in prompt:
            timer.callback_group.attended = not strange
        if strange:
            return False
        others = [timer for timer in timers if self.can_execute(timer)]
        # Who makes or destroys an entity wakes the executor; until then handles are held.
        with ExitStack() as held:
            self._call_until_something_else(prompt, others, held)
        return True

    def _call_until_something_else(self, prompt: list, others: list, held: ExitStack) -> None:
        """Call prompt timers and subscriptions as they become ready, until anything else is."""
        def hold(entities: Iterable) -> list:
            handles = [entity.handle for entity in entities]
            for handle in handles:
                held.enter_context(handle)
            return handles

        def of_nodes(kind: str) -> list:
            return [entity for node in self.get_nodes() for entity in getattr(node, kind)
                    if self.can_execute(entity)]

        receivers = {one.handle.pointer: one for one in of_nodes('subscriptions')}
        context, = hold([self._context])
        timers, subscriptions = hold([*prompt, *others]), hold(receivers.values())
        services, guards = hold(of_nodes('services')), hold([self._guard, self._sigint_gc])
        wait_set = rclpy_implementation.WaitSet(
            len(subscriptions), len(guards), len(timers), 0, len(services), 0, context)
        additions: list[tuple[Callable, Any]] = [
            *((wait_set.add_timer, handle) for handle in timers),
            *((wait_set.add_subscription, handle) for handle in subscriptions),
            *((wait_set.add_service, handle) for handle in services),
            *((wait_set.add_guard_condition, handle) for handle in guards)]
        calls = {timer.handle.pointer: timer for timer in prompt}
        ready, something_else = wait_set.get_ready_entities, False
        while not something_else:
            wait_set.clear_entities()
            for add, handle in additions:
                add(handle)
            wait_set.wait(-1)
            something_else = bool(ready('guard_condition') or ready('service'))
            received = ready('subscription')
            for pointer in ready('timer'):
                if pointer in calls:
                    _call(calls[pointer])
                else:
                    something_else = True
            for pointer in received:
                _receive(receivers[pointer])


def _call(timer: Timer) -> None:
    if timer.handle.is_timer_ready():       # not so after `cancel`
        timer.handle.call_timer()
        timer.callback()


def _receive(subscription: Subscription) -> None:
    taken = subscription.handle.take_message(subscription.msg_type, subscription.raw)
    if taken is not None:
        message_only = subscription._callback_type is Subscription.CallbackType.MessageOnly
        subscription.callback(*taken[:1 if message_only else 2])
