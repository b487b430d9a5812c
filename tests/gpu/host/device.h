// What CUDA C has beyond C++, for kernels that g++ compiles: the threads of a block take turns on one thread of the CPU.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>
#ifdef HOST_TOOLKIT
// Types of few bits, for candle's kernels. They compute on the host, too, but for what stands at the end of this file.
#include <cuda_bf16.h>
#include <cuda_fp16.h>
#include <cuda_fp8.h>
#undef __device__
#undef __host__
#undef __forceinline__
#undef __noinline__
#undef __launch_bounds__
#undef __shared__
#undef __constant__
#define __CUDACC_VER_MAJOR__ 13
#define __CUDACC_VER_MINOR__ 0
#define __CUDA_ARCH__ 800
#endif

struct CudaIndex { unsigned int x, y, z; };
extern "C" {
extern CudaIndex host_thread, host_block, host_block_size, host_grid_size;
// Lets the other threads of the block go on until they come here, too.
void host_meet();
// Room that all lanes of this thread's warp see.
void *host_warp_room();
}

#define threadIdx host_thread
#define blockIdx host_block
#define blockDim host_block_size
#define gridDim host_grid_size
#define warpSize 32
#define __device__
#define __host__
#define __forceinline__ inline
#define __noinline__
#define __launch_bounds__(...)
#define __restrict__ __restrict
// Blocks run one after the other.
#define __shared__ static
#define __constant__ static const

static inline void __syncthreads() { host_meet(); }

static inline unsigned int host_lane() {
    return (host_thread.x + host_block_size.x * (host_thread.y + host_block_size.y * host_thread.z)) % 32;
}

template <class T> static inline T host_exchange(T value, unsigned int from) {
    static_assert(sizeof(T) <= 16, "a lane's room");
    char *room = (char *)host_warp_room();
    memcpy(room + 16 * host_lane(), &value, sizeof value);
    host_meet();
    T found;
    memcpy(&found, room + 16 * (from % 32), sizeof found);
    host_meet();
    return found;
}

template <class T> static inline T __shfl_xor_sync(unsigned int, T value, int lanes, int = 32) {
    return host_exchange(value, host_lane() ^ lanes);
}

static inline float __uint_as_float(unsigned int bits) { float f; memcpy(&f, &bits, 4); return f; }
static inline unsigned int __float_as_uint(float f) { unsigned int bits; memcpy(&bits, &f, 4); return bits; }
static inline int __float_as_int(float f) { int bits; memcpy(&bits, &f, 4); return bits; }
static inline float __int_as_float(int bits) { float f; memcpy(&f, &bits, 4); return f; }
static inline long long __double_as_longlong(double f) { long long bits; memcpy(&bits, &f, 8); return bits; }
static inline double __longlong_as_double(long long bits) { double f; memcpy(&f, &bits, 8); return f; }

// One thread of the CPU does what all threads do.
template <class T, class U> static inline T atomicAdd(T *at, U value) { T old = *at; *at = T(old + value); return old; }
template <class T, class U> static inline T atomicMax(T *at, U value) { T old = *at; *at = std::max(old, T(value)); return old; }
template <class T, class U> static inline T atomicMin(T *at, U value) { T old = *at; *at = std::min(old, T(value)); return old; }
template <class T> static inline T atomicCAS(T *at, T known, T value) { T old = *at; if (old == known) *at = value; return old; }
template <class T> static inline T __ldg(const T *at) { return *at; }
#define __expf expf
#define __logf logf
static inline float rsqrtf(float x) { return 1.0f / sqrtf(x); }
static inline float normcdff(float x) { return 0.5f * erfcf(-x * 0.70710678f); }
static inline double rsqrt(double x) { return 1.0 / std::sqrt(x); }
static inline double normcdf(double x) { return 0.5 * std::erfc(-x * 0.7071067811865476); }
using std::isnan;
using std::isinf;
using std::signbit;
using std::max;
using std::min;

#ifdef HOST_TOOLKIT
// By way of f32, rounded once.
#define HOST_ROUNDED(name, value) \
    static inline __half h##name(__half x) { float f = __half2float(x); return __float2half(value); } \
    static inline __nv_bfloat16 h##name(__nv_bfloat16 x) { float f = __bfloat162float(x); return __float2bfloat16(value); }
HOST_ROUNDED(sqrt, sqrtf(f))
HOST_ROUNDED(cos, cosf(f))
HOST_ROUNDED(sin, sinf(f))
HOST_ROUNDED(log, logf(f))
HOST_ROUNDED(exp, expf(f))
HOST_ROUNDED(ceil, ceilf(f))
HOST_ROUNDED(floor, floorf(f))
HOST_ROUNDED(rint, rintf(f))
HOST_ROUNDED(trunc, truncf(f))
#endif
