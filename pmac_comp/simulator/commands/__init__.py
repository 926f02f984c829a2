"""On-line commands of the simulated card, grouped as the manual groups them."""
