"""How the tables of the terrain are learnt."""
