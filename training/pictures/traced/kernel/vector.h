// Vectors, random numbers and noise for host and device.
#pragma once
#include <cmath>
#include <cstdint>
#ifdef __CUDACC__
#define HD __host__ __device__ inline
#else
#define HD inline
#endif

struct V3 { float x, y, z; };
HD V3 v3(float x, float y, float z) { V3 r = {x, y, z}; return r; }
HD V3 operator+(V3 a, V3 b) { return v3(a.x + b.x, a.y + b.y, a.z + b.z); }
HD V3 operator-(V3 a, V3 b) { return v3(a.x - b.x, a.y - b.y, a.z - b.z); }
HD V3 operator*(V3 a, V3 b) { return v3(a.x * b.x, a.y * b.y, a.z * b.z); }
HD V3 operator*(float s, V3 a) { return v3(s * a.x, s * a.y, s * a.z); }
HD float dot(V3 a, V3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
HD V3 cross(V3 a, V3 b) { return v3(a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x); }
HD V3 unit(V3 a) { return (1.0f / sqrtf(fmaxf(dot(a, a), 1e-20f))) * a; }
HD V3 mix(V3 a, V3 b, float t) { return a + t * (b - a); }
HD float clamp1(float x) { return fminf(fmaxf(x, 0.0f), 1.0f); }
// Smooth from 0 at low to 1 at high; swapped bounds turn it round.
HD float step2(float x, float low, float high) {
    float t = clamp1((x - low) / (high - low));
    return t * t * (3.0f - 2.0f * t);
}

struct Rng { uint32_t s; };
HD uint32_t scrambled(uint32_t x) {
    x ^= x >> 16; x *= 0x7feb352du; x ^= x >> 15; x *= 0x846ca68bu; x ^= x >> 16;
    return x;
}
HD float next(Rng& r) {
    r.s = r.s * 747796405u + 2891336453u;
    uint32_t w = ((r.s >> ((r.s >> 28) + 4u)) ^ r.s) * 277803737u;
    return (float)(((w >> 22) ^ w) >> 8) * (1.0f / 16777216.0f);
}
HD uint32_t hash3(int x, int y, int z) { return scrambled((uint32_t)x * 73856093u ^ (uint32_t)y * 19349663u ^ (uint32_t)z * 83492791u); }

HD float corner(int ix, int iy, int iz, float x, float y, float z) {
    uint32_t h = hash3(ix, iy, iz);
    float a = (float)(h & 1023u) * (1.0f / 511.5f) - 1.0f, b = (float)((h >> 10) & 1023u) * (1.0f / 511.5f) - 1.0f;
    float c = (float)((h >> 20) & 1023u) * (1.0f / 511.5f) - 1.0f;
    return a * x + b * y + c * z;
}
// Gradient noise, about -0.8..0.8.
HD float perlin(V3 p) {
    float fx = floorf(p.x), fy = floorf(p.y), fz = floorf(p.z);
    int i = (int)fx, j = (int)fy, k = (int)fz;
    float x = p.x - fx, y = p.y - fy, z = p.z - fz;
    float u = x * x * x * (x * (6.0f * x - 15.0f) + 10.0f), v = y * y * y * (y * (6.0f * y - 15.0f) + 10.0f);
    float w = z * z * z * (z * (6.0f * z - 15.0f) + 10.0f);
    float r[2];
    for (int c = 0; c < 2; c++) {
        float a = corner(i, j, k + c, x, y, z - c), b = corner(i + 1, j, k + c, x - 1, y, z - c);
        float d = corner(i, j + 1, k + c, x, y - 1, z - c), e = corner(i + 1, j + 1, k + c, x - 1, y - 1, z - c);
        float low = a + u * (b - a), high = d + u * (e - d);
        r[c] = low + v * (high - low);
    }
    return r[0] + w * (r[1] - r[0]);
}
// Fractal noise about 0.5.
HD float fbm(V3 p, int octaves, float rough) {
    float sum = 0.0f, size = 1.0f, total = 0.0f;
    if (octaves < 1) octaves = 1;
    for (int i = 0; i < octaves; i++) {
        sum += size * perlin(p);
        total += size;
        size *= rough;
        p = v3(2.03f * p.x + 17.1f, 2.01f * p.y - 9.3f, 2.05f * p.z + 4.7f);
    }
    return 0.5f + 0.62f * sum / total;
}
// Cells: distance to the nearest point, difference to the second, a random number of the cell.
HD V3 cells(V3 p) {
    int i = (int)floorf(p.x), j = (int)floorf(p.y), k = (int)floorf(p.z);
    float first = 9.0f, second = 9.0f, own = 0.0f;
    for (int a = -1; a <= 1; a++)
        for (int b = -1; b <= 1; b++)
            for (int c = -1; c <= 1; c++) {
                uint32_t h = hash3(i + a, j + b, k + c);
                float x = i + a + (h & 1023u) / 1023.0f - p.x, y = j + b + ((h >> 10) & 1023u) / 1023.0f - p.y;
                float z = k + c + ((h >> 20) & 1023u) / 1023.0f - p.z;
                float d = sqrtf(x * x + y * y + z * z);
                if (d < first) { second = first; first = d; own = (scrambled(h) & 1023u) / 1023.0f; }
                else if (d < second) second = d;
            }
    return v3(first, second - first, own);
}
HD V3 ramp(const V3* tones, int n, float t, float low, float high) {
    float x = clamp1((t - low) / (high - low)) * (n - 1);
    int i = (int)x;
    if (i > n - 2) i = n - 2;
    return mix(tones[i], tones[i + 1], x - i);
}
