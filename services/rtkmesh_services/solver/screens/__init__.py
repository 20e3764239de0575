"""What RTKRCV's console shows for its words, from a solver's own values. Layouts are those of rtkrcv 2.4.3 b34."""
