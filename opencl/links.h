/* Links of nodes, and lines of nodes, for adjoint.cl and gauss_newton.cl. */
/* Where the k-th link of node p stands, with room for `count` of a node. */
int link_at(int p, int k, int count)
{
  return (p / LINK_BLOCK * count + k) * LINK_BLOCK + p % LINK_BLOCK;
}

/* Node i of a line of n, which may lie one beyond its ends. */
int on_line(int i, int n, int sides)
{
  return sides == PERIODIC ? (i + n) % n : clamp(i, 0, n - 1);
}

/* 1 over the distance of the nodes on both sides of node i of n, or of it and its one neighbour. */
float half_within(int i, int n, int sides)
{
  return sides == PERIODIC || (i > 0 && i < n - 1) ? 0.5f : 1.0f;
}

/* Central difference of v along a line of n nodes, `step` apart in memory, about node i of it. */
float rise_at(__global const float *v, int i, int n, int step, int sides)
{
  return (v[on_line(i + 1, n, sides) * step] - v[on_line(i - 1, n, sides) * step]) * half_within(i, n, sides);
}
