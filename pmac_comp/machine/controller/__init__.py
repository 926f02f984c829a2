"""What a PMAC has: variables, motors, tables, gather, open servo, backup, upload.

From what is asked of a card to a change of it that is whole or not at all::

    asked          card
    gathered       gather
    what it holds  contents
    a change       change
    motors         motors
    of its parts   tables settings law
    of all         whole

Each folder imports only from those above it; ``gather`` and ``contents`` do not know each other.
"""
