"""What an operator runs beside the router."""
