"""Lead table, dynamic law, trajectory pre-compensation and limiting; all in SI."""
