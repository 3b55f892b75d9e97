"""Scene graphs: computation of relations, abstractions (simpler labelled graphs), and online generation."""
