"""How right an answer is: warnings and estimates of errors."""
