"""What the requirements of a hand cover: members of the messages by phases, and what is sent there.

Nothing of it is declared: the reference goes through every phase of a default run on the virtual
clock, each check judges the recording, and what it reads is noted. A member that no check reads, a
mode that is never sent, or a client that never drives the hand, is a hole, and is named.
"""
