// What CUDA C has beyond C++, for kernels that g++ compiles: the threads of a block take turns on one thread of the CPU.
#pragma once
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>

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
