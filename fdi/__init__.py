"""The mathematics: residuals, observers, filters, statistical tests, isolation.  Arrays in, arrays out."""
