"""A bus inside one program, for tests of the mailbox and of the relay without ROS."""

from collections import defaultdict
from typing import Any

from falconwing_kit.tools.bridge.bus import Mailbox, require_message, require_topic


class LocalBus:
    """The interface of RosBus; publishing is safe from any thread."""

    def __init__(self) -> None:
        self._mailboxes: dict[str, list[Mailbox]] = defaultdict(list)

    def publish(self, topic: str, message: Any) -> None:
        """Send a message to all current subscribers."""
        require_message(topic, message)
        for mailbox in self._mailboxes[topic]:
            mailbox.put(message)

    def subscribe(self, topic: str) -> Mailbox:
        """A mailbox for the messages from now on."""
        self._mailboxes[require_topic(topic)].append(mailbox := Mailbox())
        return mailbox

    def listeners(self, topic: str) -> int:
        """Number of subscribers of a topic."""
        return len(self._mailboxes[require_topic(topic)])

    def close(self) -> None:
        """Remove all subscribers."""
        self._mailboxes.clear()
