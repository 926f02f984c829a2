"""What a card holds, as values: tables, bank of the law, programs, settings; and their limits."""
