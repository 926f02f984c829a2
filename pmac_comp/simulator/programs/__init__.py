"""What runs on the card beside the servo task: motion programs, rotary buffers, PLCs."""
