"""The simulated Turbo PMAC: memory, language, servo task, programs, plant, conversations.

From the bits of a card to the clients that reach it::

    its memory     memory
    its language   language
    the drive      plant
    servo cycle    servo
    beside it      programs
    on-line        commands dialog
    put together   card
    for clients    serving

Each folder imports only from those above it; only types of the card are named below it.
"""
