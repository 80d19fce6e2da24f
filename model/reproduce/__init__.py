"""The study of the paper's claims: which networks it trains, what it asks of them, and what it
finds."""
