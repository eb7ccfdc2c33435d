/* Strips of visible ground, for interreflection.cl and, with derivatives, adjoint.cl. */
/* Arc tangent of any v to 2e-7, by a polynomial fitted for least maximum error. */
floats arctan(floats v)
{
  const floats a = v < 0 ? -v : v, r = a > 1 ? 1 / a : a, q = r * r;
  floats p = (floats)ARC_TANGENT_0 * q + ARC_TANGENT_1;
  p = p * q + ARC_TANGENT_2;
  p = p * q + ARC_TANGENT_3;
  p = p * q + ARC_TANGENT_4;
  p = p * q + ARC_TANGENT_5;
  p = p * q + ARC_TANGENT_6;
  p = p * q + ARC_TANGENT_7;
  p = a > 1 ? HALF_PI - p * r : p * r;
  return v < 0 ? -p : p;
}

/* Share of what lies below a slope, up to a constant: the integral of N.L over elevations for an element
   whose tangent plane rises by `plane`, over half the upward part of N. */
floats below(floats slope, floats plane)
{
  const floats q = 1 / (slope * slope + 1);
  return -plane * (arctan(slope) + slope * q) - q;
}
