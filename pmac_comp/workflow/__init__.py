"""The bridge between the towers: capture, model, compensate, upload, verify, improve.

The only place of both. The way of the data, and the folder or modules of each part of it::

    bench file     bench
    figures        accuracy
    trajectory     motion
    capture        capture
    model          model
    its law        law
    compensation   compensation
    controller     controller
    before, after  verification
    all of it      demo improve previews

Each folder imports only from those above it; ``capture`` and ``model`` do not know each other.
"""
